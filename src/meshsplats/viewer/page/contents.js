// What the page shows: the mesh, the splats, a textured surface, or two of them side by side; and how.

import { connectDivider } from "./controls.js";
import { element } from "./status.js";

const PAIRS = [["splats", "mesh"], ["surface", "mesh"], ["splats", "surface"]];

export class Contents {
  // kinds: what there is, of "mesh", "splats" and "surface".
  constructor(kinds) {
    this.split = 0.5;
    this.#have(kinds);
  }

  #have(kinds) {
    const pairs = PAIRS.filter(pair => pair.every(kind => kinds.includes(kind)));
    Object.assign(this, { kinds, pairs });
    if (!pairs.includes(this.pair)) this.pair = pairs[0];
    if (!(this.chosen === "both" ? pairs.length : kinds.includes(this.chosen)))
      this.chosen = kinds.find(kind => kind !== "splats") ?? kinds[0];
  }

  // Parts of the image's width, 0 to 1, and what each shows.
  get parts() {
    const { chosen, pair, split } = this;
    if (chosen !== "both") return [{ what: chosen, from: 0, to: 1 }];
    const sides = [{ what: pair[0], from: 0, to: split }, { what: pair[1], from: split, to: 1 }];
    return sides.filter(({ from, to }) => to > from);
  }

  shows(kind) { return this.parts.some(({ what }) => what === kind); }

  // Takes back a kind that cannot be drawn, which is not the only one.
  withdraw(kind) {
    this.#have(this.kinds.filter(other => other !== kind));
    this.#offer();
  }

  // The settings, of what there is.
  #offer() {
    const { kinds, pairs, chosen } = this;
    for (const input of document.querySelectorAll("[name=content]")) {
      input.checked = input.value === chosen;
      input.disabled = input.value === "both" ? !pairs.length : !kinds.includes(input.value);
      input.closest("label").hidden = input.disabled;
    }
    element("content").closest("fieldset").hidden = kinds.length < 2;
    element("pair").replaceChildren(
      ...pairs.map(([left, right], i) => new Option(`${left}, ${right}`, String(i))));
    element("pair").value = String(pairs.indexOf(this.pair));
    element("pairLine").hidden = pairs.length < 2;
    this.#name();
  }

  // The boundary.
  #name() {
    const { pair, chosen } = this, divider = element("divider");
    divider.hidden = chosen !== "both";
    if (!pair) return;
    divider.setAttribute("aria-label", `Boundary between ${pair.join(" and ")}`);
    [".left", ".right"].forEach((end, i) => { divider.querySelector(end).textContent = pair[i]; });
  }

  // The settings and the boundary; `changed` is called when something else is shown.
  connect(stage, changed) {
    for (const input of document.querySelectorAll("[name=content]")) {
      input.addEventListener("change", () => {
        this.chosen = input.value;
        this.#name();
        changed();
      });
    }
    if (!this.kinds.includes("mesh")) { // a depth buffer blends nothing
      const blended = document.querySelector("[name=style][value=blended]");
      blended.disabled = blended.closest("label").hidden = true;
      document.querySelector("[name=style][value=opaque]").checked = true;
    }
    element("pair").addEventListener("change", event => {
      this.pair = this.pairs[Number(event.target.value)];
      this.#name();
      changed();
    });
    this.#offer();
    connectDivider(element("divider"), stage, split => {
      this.split = split;
      changed();
    });
  }
}

// The settings of the image, which is drawn again when one of `options` is another.
export function connectOptions(options, background, changed) {
  const paint = () => {
    const { value } = element("background");
    options.background = [1, 3, 5].map(i => parseInt(value.slice(i, i + 2), 16) / 255);
    document.body.style.background = value;
    changed();
  };
  element("background").value = background;
  element("background").addEventListener("input", paint);
  paint();
  element("exposure").addEventListener("input", event => {
    const stops = Number(event.target.value);
    options.gain = 2 ** stops;
    element("exposureText").value = `${stops > 0 ? "+" : ""}${stops} EV`;
    changed();
  });
  element("samples").addEventListener("change", event => {
    options.samples = Number(event.target.value);
    changed();
  });
  const choices = [...document.querySelectorAll("[name=style]"), element("renderer")];
  for (const choice of choices) {
    choice.addEventListener("change", () => {
      options[choice.name || choice.id] = choice.value;
      changed();
    });
  }
}
