// Compiles WGSL with Dawn, on a device with WebGPU's core limits that draws nothing: no driver is needed.
//
//   node compile_with_dawn.mjs FOLDER < sources.json      sources: {name: {code, entries}}; answers {name: [problem, ...]}
//
// `npm install webgpu` was run in FOLDER.

import fs from 'fs';
import { createRequire } from 'module';
import path from 'path';
import { pathToFileURL } from 'url';

const require = createRequire(path.resolve(process.argv[2], 'index.js'));
const { create, globals } = await import(pathToFileURL(require.resolve('webgpu')).href);
Object.assign(globalThis, globals);
const gpu = create(['backend=null']);
const device = await (await gpu.requestAdapter()).requestDevice();
const answer = {};
for (const [name, { code, entries }] of Object.entries(JSON.parse(fs.readFileSync(0)))) {
  const problems = (answer[name] = []);
  device.pushErrorScope('validation');
  const module = device.createShaderModule({ code });
  for (const message of (await module.getCompilationInfo()).messages)
    problems.push(`${message.lineNum}: ${message.message}`);
  const error = await device.popErrorScope();
  if (error) continue; // the messages above say what; each entry would say it again
  for (const entryPoint of entries) {
    try {
      await device.createComputePipelineAsync({ layout: 'auto', compute: { module, entryPoint } });
    } catch (problem) {
      problems.push(`${entryPoint}: ${problem.message}`);
    }
  }
}
console.log(JSON.stringify(answer));
process.exit(0); // Dawn's threads would keep node
