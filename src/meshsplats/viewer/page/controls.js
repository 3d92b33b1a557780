// The view and what moves it: mouse, touch, keys, flights. The boundary and the panel.

import { View, add, dot } from "./camera.js";

const FLIGHT = 450; // milliseconds from one view to the next
const STEP = 0.05; // radians of an arrow key
const ZOOM = 0.85; // of a press of +
// powers of e that zoom: a pixel of the wheel; one of a pinch on a trackpad, which browsers report as a wheel
// with Ctrl; the most of an event
const WHEEL = 0.0015, PINCH = 0.01, MOST = 0.45;
// controls that arrows and Home move
const WITH_ARROWS = "[type=radio], [type=range], [role=slider]", MOVES = /^(Arrow|Home)/;
const FLIES = /^[wasdqe]$/, ZOOMS = /^[+=-]$/, WITH_ALT = /^[[\]]$/; // with Alt on some keyboards of Macs

const calm = matchMedia("(prefers-reduced-motion: reduce)");

// The view and its motion. What extends it has changed(), which is called when the view is another.
export class ViewController {
  constructor(settings) {
    this.settings = settings;
    this.view = this.#viewOf(0);
    this.camera = 0;
    this.flying = false;
    this.thrust = [0, 0, 0];
  }

  #viewOf(index) {
    const { cameras, up, center, radius } = this.settings, view = new View(cameras[index], up, 1);
    view.distance = Math.max(dot(add(center, view.position, -1), view.forward), 0.2 * radius);
    return view;
  }

  jump(index) {
    const count = this.settings.cameras.length;
    this.camera = (index + count) % count;
    document.getElementById("cameras").value = String(this.camera);
    this.flyTo(this.#viewOf(this.camera));
  }

  // In a moment; at once where motion is unwelcome.
  flyTo(target) {
    this.flight = calm.matches ? null : { from: this.view.copy(), target, start: performance.now() };
    if (!this.flight) this.view = target;
    this.changed();
  }

  // begun: a key went down just now; even the shortest press moves the camera.
  fly(keys, fast, begun = false) {
    const pressed = (plus, minus) => Number(keys.has(plus)) - Number(keys.has(minus));
    const speed = this.settings.radius * (fast ? 2.4 : 0.6);
    this.thrust = [pressed("d", "a"), pressed("q", "e"), pressed("w", "s")].map(value => value * speed);
    if (begun) this.#move(1 / 60);
    if (keys.size) this.changed();
  }

  get moves() { return Boolean(this.flight) || Boolean(this.spinning) || this.thrust.some(Boolean); }

  advance(seconds) {
    if (!this.moves) return;
    this.changed();
    if (this.flight) {
      const t = Math.min(1, (performance.now() - this.flight.start) / FLIGHT);
      this.view = this.flight.from.towards(this.flight.target, t < 1 ? t * t * (3 - 2 * t) : 1);
      if (t === 1) this.flight = null;
    }
    if (this.spinning) this.view.orbit(seconds * 0.5, 0);
    if (this.thrust.some(Boolean)) this.#move(seconds);
  }

  #move(seconds) { this.view.move(...this.thrust.map(value => value * seconds), this.settings.radius); }
}

// They move the view of `controller`, a ViewController with command(name) and pick(x, y), and end its flight
// to another.
// radius: of the scene.
export function connect(stage, controller, radius) {
  const touches = new Map(), keys = new Set();
  const shorter = () => Math.min(stage.clientWidth, stage.clientHeight);
  const pan = (x, y) => controller.view.pan(x, y, stage.clientWidth, stage.clientHeight);
  const grab = () => { controller.flight = null; };

  stage.addEventListener("pointerdown", event => {
    if (event.target.closest("#divider")) return;
    stage.setPointerCapture(event.pointerId);
    grab();
    touches.set(event.pointerId, { x: event.clientX, y: event.clientY,
      pans: event.button > 0 || event.shiftKey });
    stage.classList.add("dragging");
    stage.focus({ preventScroll: true });
  });
  const leave = event => {
    touches.delete(event.pointerId);
    if (!touches.size) stage.classList.remove("dragging");
  };
  for (const name of ["pointerup", "pointercancel", "lostpointercapture"])
    stage.addEventListener(name, leave);
  stage.addEventListener("pointermove", event => {
    const touch = touches.get(event.pointerId);
    if (!touch) return;
    const before = pair(touches), x = event.clientX - touch.x, y = event.clientY - touch.y;
    if (x === 0 && y === 0) return;
    Object.assign(touch, { x: event.clientX, y: event.clientY });
    const { view } = controller, side = shorter();
    if (touches.size >= 2) {
      const after = pair(touches);
      pan(after.x - before.x, after.y - before.y);
      if (after.apart > 10 && before.apart > 10) view.zoom(before.apart / after.apart, radius);
    } else if (touch.pans) {
      pan(x, y);
    } else if (controller.flying) {
      view.look(x / side * 1.2, -y / side * 1.2);
    } else {
      view.orbit(-x / side * 4, y / side * 4);
    }
    controller.changed();
  });
  stage.addEventListener("wheel", event => {
    event.preventDefault();
    grab();
    const pixels = event.deltaY * (event.deltaMode === 1 ? 30 : event.deltaMode === 2 ? 300 : 1);
    const power = pixels * (event.ctrlKey ? PINCH : WHEEL);
    controller.view.zoom(Math.exp(Math.max(-MOST, Math.min(MOST, power))), radius);
    controller.changed();
  }, { passive: false });
  stage.addEventListener("contextmenu", event => event.preventDefault());
  stage.addEventListener("dblclick", event => {
    if (event.target.closest("#divider")) return;
    const bounds = stage.getBoundingClientRect();
    controller.pick(event.clientX - bounds.left, event.clientY - bounds.top);
  });

  const once = {
    Home: "home", "[": "previous", "]": "next", 1: "mesh", 2: "both", 3: "splats", 4: "surface",
    b: "blended", o: "opaque", x: "wireframe", h: "plain",
  };
  // A list takes letters for itself: one that was used by mouse or touch gives the keys back to the scene.
  let pressed = null;
  document.addEventListener("pointerdown", event => { pressed = event.target; }, true);
  document.addEventListener("change", event => {
    if (event.target === pressed && pressed.matches("select")) stage.focus({ preventScroll: true });
  });
  const release = () => {
    keys.clear();
    controller.fly(keys, false);
  };
  document.addEventListener("keydown", event => {
    pressed = null;
    if (event.key === "Meta") release(); // macOS tells of no key that goes up while this one is down
    const key = labelOf(event), place = placeOf(event);
    if (event.ctrlKey || event.metaKey || event.altKey && !WITH_ALT.test(key)) return;
    if (event.target.matches("select") || event.target.matches(WITH_ARROWS) && MOVES.test(key)) return;
    const { view } = controller, flies = FLIES.test(place), command = once[key] ?? once[place];
    if (flies || key.startsWith("Arrow") || ZOOMS.test(key)) grab();
    if (flies) {
      keys.add(place);
      controller.fly(keys, event.shiftKey, !event.repeat);
    } else if (ZOOMS.test(key)) { // before commands: a + may be at the place of a digit
      view.zoom(key === "-" ? 1 / ZOOM : ZOOM, radius);
      controller.changed();
    } else if (command) {
      if (!event.repeat) controller.command(command);
    } else if (key.startsWith("Arrow")) {
      const x = Number(key === "ArrowRight") - Number(key === "ArrowLeft");
      const y = Number(key === "ArrowDown") - Number(key === "ArrowUp");
      if (event.shiftKey) pan(-x * STEP * shorter(), -y * STEP * shorter());
      else if (controller.flying) view.look(-x * STEP, y * STEP);
      else view.orbit(x * STEP * 2, -y * STEP * 2);
      controller.changed();
    } else {
      return;
    }
    event.preventDefault();
  });
  document.addEventListener("keyup", event => {
    keys.delete(placeOf(event));
    if (event.key === "Meta") keys.clear();
    controller.fly(keys, event.shiftKey);
  });
  window.addEventListener("blur", release);
}

// The name of a key, in small letters where it is one.
const labelOf = ({ key }) => key.length === 1 ? key.toLowerCase() : key;

// The letter or digit at its place on an English keyboard, where it has one there: others have other letters
// there, and some the same ones elsewhere.
const placeOf = event => /^(?:Key|Digit)(.)$/.exec(event.code)?.[1].toLowerCase() ?? labelOf(event);

// Middle and distance of the first two touches.
function pair(touches) {
  const [a, b = a] = touches.values();
  return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, apart: Math.hypot(a.x - b.x, a.y - b.y) };
}

// The boundary between two contents: moved(share) while it is dragged or moved by keys.
export function connectDivider(divider, stage, moved) {
  const set = share => {
    const value = Math.max(0, Math.min(1, share));
    divider.style.left = `${100 * value}%`;
    divider.setAttribute("aria-valuenow", String(Math.round(100 * value)));
    moved(value);
  };
  const at = event => set((event.clientX - stage.getBoundingClientRect().left) / stage.clientWidth);
  divider.addEventListener("pointerdown", event => {
    event.stopPropagation();
    divider.setPointerCapture(event.pointerId);
  });
  divider.addEventListener("pointermove", event => {
    if (divider.hasPointerCapture(event.pointerId)) at(event);
  });
  divider.addEventListener("keydown", event => {
    const now = Number(divider.getAttribute("aria-valuenow")) / 100;
    const steps = { ArrowLeft: now - 0.02, ArrowRight: now + 0.02, PageDown: now - 0.1, PageUp: now + 0.1,
      Home: 0, End: 1 };
    if (!(event.key in steps)) return;
    set(steps[event.key]);
    event.preventDefault();
    event.stopPropagation();
  });
}

// The panel of the settings: `toggle` opens and closes it, Escape closes it. It begins open where it leaves
// the subject free: in wide windows, not within another page.
export function connectPanel(panel, toggle) {
  const open = shown => {
    panel.classList.toggle("closed", !shown);
    toggle.setAttribute("aria-expanded", String(shown));
  };
  toggle.addEventListener("click", () => open(panel.classList.contains("closed")));
  document.querySelector(".skip").addEventListener("click", event => {
    event.preventDefault();
    open(true);
    panel.focus();
  });
  document.addEventListener("keydown", event => {
    if (event.key !== "Escape" || panel.classList.contains("closed")) return;
    open(false);
    toggle.focus();
  });
  open(matchMedia("(min-width: 1000px)").matches && window === window.parent);
}

export function fillCameras(list, cameras) {
  cameras.forEach((camera, i) => {
    const option = document.createElement("option");
    option.value = String(i);
    option.textContent = camera.name || `camera ${i + 1}`;
    list.append(option);
  });
}
