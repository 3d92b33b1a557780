// Mouse, touch and keys: they move the view of `pilot`, {view, changed(), flying, command(name), pick(x, y)}.

const STEP = 0.05; // radians of an arrow key
const ZOOM = 0.85; // of a press of +
// powers of e that zoom: a pixel of the wheel; one of a pinch on a trackpad, which browsers report as a wheel
// with Ctrl; the most of an event
const WHEEL = 0.0015, PINCH = 0.01, MOST = 0.45;
// controls that arrows and Home move
const WITH_ARROWS = "[type=radio], [type=range], [role=slider]", MOVES = /^(Arrow|Home)/;

// radius: of the scene.
export function connect(stage, pilot, radius) {
  const touches = new Map(), keys = new Set();
  const shorter = () => Math.min(stage.clientWidth, stage.clientHeight);
  const pan = (x, y) => pilot.view.pan(x, y, stage.clientWidth, stage.clientHeight);

  stage.addEventListener("pointerdown", event => {
    if (event.target.closest("#divider")) return;
    stage.setPointerCapture(event.pointerId);
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
    const { view } = pilot, side = shorter();
    if (touches.size >= 2) {
      const after = pair(touches);
      pan(after.x - before.x, after.y - before.y);
      if (after.apart > 10 && before.apart > 10) view.zoom(before.apart / after.apart, radius);
    } else if (touch.pans) {
      pan(x, y);
    } else if (pilot.flying) {
      view.look(x / side * 1.2, -y / side * 1.2);
    } else {
      view.orbit(-x / side * 4, y / side * 4);
    }
    pilot.changed();
  });
  stage.addEventListener("wheel", event => {
    event.preventDefault();
    const pixels = event.deltaY * (event.deltaMode === 1 ? 30 : event.deltaMode === 2 ? 300 : 1);
    const power = pixels * (event.ctrlKey ? PINCH : WHEEL);
    pilot.view.zoom(Math.exp(Math.max(-MOST, Math.min(MOST, power))), radius);
    pilot.changed();
  }, { passive: false });
  stage.addEventListener("contextmenu", event => event.preventDefault());
  stage.addEventListener("dblclick", event => {
    if (event.target.closest("#divider")) return;
    const bounds = stage.getBoundingClientRect();
    pilot.pick(event.clientX - bounds.left, event.clientY - bounds.top);
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
  document.addEventListener("keydown", event => {
    pressed = null;
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (event.target.matches("select") || event.target.matches(WITH_ARROWS) && MOVES.test(key)) return;
    const { view } = pilot;
    if (once[key]) {
      if (!event.repeat) pilot.command(once[key]);
    } else if ("wasdqe".includes(key)) {
      keys.add(key);
      pilot.fly(keys, event.shiftKey, !event.repeat);
    } else if (key.startsWith("Arrow")) {
      const x = Number(key === "ArrowRight") - Number(key === "ArrowLeft");
      const y = Number(key === "ArrowDown") - Number(key === "ArrowUp");
      if (event.shiftKey) pan(-x * STEP * shorter(), -y * STEP * shorter());
      else if (pilot.flying) view.look(-x * STEP, y * STEP);
      else view.orbit(x * STEP * 2, -y * STEP * 2);
      pilot.changed();
    } else if (key === "+" || key === "=" || key === "-") {
      view.zoom(key === "-" ? 1 / ZOOM : ZOOM, radius);
      pilot.changed();
    } else {
      return;
    }
    event.preventDefault();
  });
  document.addEventListener("keyup", event => {
    keys.delete(event.key.toLowerCase());
    pilot.fly(keys, event.shiftKey);
  });
  window.addEventListener("blur", () => {
    keys.clear();
    pilot.fly(keys, false);
  });
}

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
