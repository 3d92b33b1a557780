// What the page shows: the mesh, the splats, a textured surface, or two of them side by side.

import { connectDivider } from "./controls.js";
import { element } from "./status.js";

const PAIRS = [["splats", "mesh"], ["surface", "mesh"], ["splats", "surface"]];

export class Contents {
  // kinds: what there is, of "mesh", "splats" and "surface".
  constructor(kinds) {
    const pairs = PAIRS.filter(pair => pair.every(kind => kinds.includes(kind)));
    Object.assign(this, { kinds, pairs, pair: pairs[0], split: 0.5 });
    this.chosen = kinds.includes("mesh") ? "mesh" : "surface";
  }

  // Parts of the image's width, 0 to 1, and what each shows.
  get parts() {
    const { chosen, pair, split } = this;
    if (chosen !== "both") return [{ what: chosen, from: 0, to: 1 }];
    const sides = [{ what: pair[0], from: 0, to: split }, { what: pair[1], from: split, to: 1 }];
    return sides.filter(({ from, to }) => to > from);
  }

  shows(kind) { return this.parts.some(({ what }) => what === kind); }

  // The settings and the boundary; `changed` is called when something else is shown.
  connect(stage, changed) {
    const { kinds, pairs } = this, divider = element("divider"), list = element("pair");
    for (const input of document.querySelectorAll("[name=content]")) {
      input.checked = input.value === this.chosen;
      input.disabled = input.value === "both" ? !pairs.length : !kinds.includes(input.value);
      if (input.disabled) input.closest("label").hidden = true;
      input.addEventListener("change", () => {
        this.chosen = input.value;
        divider.hidden = this.chosen !== "both";
        changed();
      });
    }
    if (!kinds.includes("mesh")) { // a depth buffer blends nothing
      const blended = document.querySelector("[name=style][value=blended]");
      blended.disabled = blended.closest("label").hidden = true;
      document.querySelector("[name=style][value=opaque]").checked = true;
    }
    element("content").closest("fieldset").hidden = kinds.length < 2;
    pairs.forEach(([left, right], i) => list.append(new Option(`${left}, ${right}`, String(i))));
    element("pairLine").hidden = pairs.length < 2;
    const name = () => {
      divider.setAttribute("aria-label", `Boundary between ${this.pair.join(" and ")}`);
      [".left", ".right"].forEach((end, i) => { divider.querySelector(end).textContent = this.pair[i]; });
    };
    if (pairs.length) name();
    list.addEventListener("change", () => {
      this.pair = pairs[Number(list.value)];
      name();
      changed();
    });
    connectDivider(divider, stage, split => {
      this.split = split;
      changed();
    });
  }
}
