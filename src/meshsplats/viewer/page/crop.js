// The crop box: which fans, triangles and splats have their centres in it, its sliders and its outline.

import { inWorld, project } from "./camera.js";

const STEPS = 200;
const UNBOUNDED = "1e39"; // farther away than float32 reaches; commands take no infinity

export class CropBox {
  // settings: extent, [[x, y, z], [x, y, z]], where the sliders end; origin, [x, y, z] in the world, to which
  // the scene is relative. levels: meshes by name, to which others may be added later, followed by `again`.
  // changed(kept) as in SortedRenderer.crop.
  constructor({ extent, origin }, levels, splats, changed) {
    Object.assign(this, { extent, origin, levels, splats, changed });
    this.marks = [[0, 0, 0], [STEPS, STEPS, STEPS]];
    this.inputs = [];
    const grid = document.querySelector("#crop .six");
    "xyz".split("").forEach((axis, k) => {
      const name = document.createElement("b");
      name.textContent = axis;
      grid.append(name);
      for (const end of [0, 1]) {
        const input = document.createElement("input");
        Object.assign(input, { type: "range", min: 0, max: STEPS, step: 1, value: end * STEPS,
          id: `crop-${axis}${end}` });
        input.setAttribute("aria-label", `${axis}, ${end ? "upper" : "lower"} end of the crop box`);
        input.addEventListener("input", () => this.#moved(k, end, Number(input.value)));
        this.inputs.push(input);
        grid.append(input);
      }
    });
    document.getElementById("uncrop").addEventListener("click", () => this.reset());
    this.#tell();
  }

  get active() { return this.marks[0].some(mark => mark > 0) || this.marks[1].some(mark => mark < STEPS); }

  // The two corners in scene units.
  get corners() {
    return this.marks.map(marks => marks.map((mark, k) => {
      const [low, high] = [this.extent[0][k], this.extent[1][k]];
      return low + (high - low) * mark / STEPS;
    }));
  }

  reset() {
    this.marks = [[0, 0, 0], [STEPS, STEPS, STEPS]];
    this.inputs.forEach((input, i) => { input.value = this.marks[i % 2][i >> 1]; });
    this.#tell();
    this.changed(null);
  }

  again() { if (this.active) this.changed(this.#kept()); }

  #moved(axis, end, mark) {
    const other = this.marks[1 - end][axis];
    this.marks[end][axis] = end ? Math.max(mark, other + 1) : Math.min(mark, other - 1);
    this.inputs[2 * axis + end].value = this.marks[end][axis];
    this.#tell();
    this.changed(this.active ? this.#kept() : null);
  }

  // Of one end of an axis: whether its slider is at its end, where it does not bound the scene.
  #free(end, axis) { return this.marks[end][axis] === end * STEPS; }

  // Says where the box ends, to a hundredth of a slider's step.
  #tell() {
    const [low, high] = this.extent, step = Math.max(...low.map((value, k) => high[k] - value)) / STEPS;
    const numbers = this.corners.map(corner => inWorld(corner, this.origin, step / 100));
    this.inputs.forEach((input, i) => input.setAttribute("aria-valuetext",
      this.#free(i % 2, i >> 1) ? "no bound" : numbers[i % 2][i >> 1]));
    const bounds = numbers.map((corner, end) =>
      corner.map((number, k) => this.#free(end, k) ? (end ? "" : "-") + UNBOUNDED : number));
    document.getElementById("cropText").textContent =
      this.active ? `--crop ${bounds.flat().join(" ")}` : "";
  }

  #kept() {
    const kept = { splats: this.splats ? this.#within(this.splats.means) : new Uint32Array(0) };
    for (const [level, mesh] of Object.entries(this.levels)) {
      const fans = this.#within(fanMiddles(mesh)), triangles = [];
      for (const fan of fans) for (let f = mesh.fans[fan]; f < mesh.fans[fan + 1]; f++) triangles.push(f);
      kept[level] = { fans, triangles: Uint32Array.from(triangles) };
    }
    return kept;
  }

  // Indices of the points (3 each) in the box.
  #within(points) {
    const [from, to] = this.corners, kept = [];
    const low = from.map((value, k) => this.#free(0, k) ? -Infinity : value);
    const high = to.map((value, k) => this.#free(1, k) ? Infinity : value);
    for (let i = 0; i < points.length / 3; i++) {
      const x = points[3 * i], y = points[3 * i + 1], z = points[3 * i + 2];
      if (x >= low[0] && x <= high[0] && y >= low[1] && y <= high[1] && z >= low[2] && z <= high[2])
        kept.push(i);
    }
    return Uint32Array.from(kept);
  }

  // Shows the box in the image of `pinhole`, by a path in `svg`, while it is `open` or in use.
  show(svg, open, pinhole) {
    svg.toggleAttribute("hidden", !(open || this.active));
    if (open || this.active) svg.firstElementChild.setAttribute("d", this.outline(pinhole));
  }

  // The edges of the box in an image, in pixels.
  outline(pinhole) {
    const ends = this.corners, lines = [];
    const corner = bits => [0, 1, 2].map(k => ends[(bits >> k) & 1][k]);
    for (let bits = 0; bits < 8; bits++) {
      for (let k = 0; k < 3; k++) {
        if ((bits >> k) & 1) continue;
        const a = project(pinhole, corner(bits)), b = project(pinhole, corner(bits | (1 << k)));
        if (a[2] > pinhole.near && b[2] > pinhole.near) {
          lines.push(`M${a[0].toFixed(1)} ${a[1].toFixed(1)}L${b[0].toFixed(1)} ${b[1].toFixed(1)}`);
        }
      }
    }
    return lines.join("");
  }
}

// The middles of the mesh's own fans, computed once.
export function fanMiddles(mesh) {
  mesh.middles ??= middlesOf(mesh, mesh.fans);
  return mesh.middles;
}

// The mean of each fan's triangle centres.
export function middlesOf({ vertices, faces }, fans, Values = Float32Array) {
  const middles = new Values(3 * (fans.length - 1));
  for (let fan = 0; fan + 1 < fans.length; fan++) {
    const weight = 1 / (3 * (fans[fan + 1] - fans[fan]));
    for (let i = 3 * fans[fan]; i < 3 * fans[fan + 1]; i++) {
      for (let c = 0; c < 3; c++) middles[3 * fan + c] += weight * vertices[3 * faces[i] + c];
    }
  }
  return middles;
}
