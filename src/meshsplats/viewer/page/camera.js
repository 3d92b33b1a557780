// Viewpoints: a pinhole with OpenCV axes (x right, y down, z forward) that orbits a pivot or flies.

export const add = (a, b, t = 1) => [a[0] + t * b[0], a[1] + t * b[1], a[2] + t * b[2]];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2],
  a[0] * b[1] - a[1] * b[0]];
export const unit = a => { const l = Math.hypot(...a) || 1; return [a[0] / l, a[1] / l, a[2] / l]; };

// `v` turned by `angle` around the unit vector `axis`.
export function turned(v, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle), w = cross(axis, v), d = dot(axis, v) * (1 - c);
  return [c * v[0] + s * w[0] + d * axis[0], c * v[1] + s * w[1] + d * axis[1],
    c * v[2] + s * w[2] + d * axis[2]];
}

const NEAREST = 1e-3, FARTHEST = 50; // distances of the pivot that zooming reaches, in radii of the scene
const NEAR = 0.1; // the near plane of a view that came nearer, at most: share of the distance of the pivot

export class View {
  // camera: {matrix: 12 numbers, the rows of world to camera; fx, fy, cx, cy, width, height, near}; up: unit
  // vector; distance: of the pivot before the camera.
  constructor(camera, up, distance) {
    this.up = up;
    const m = camera.matrix;
    this.right = unit([m[0], m[1], m[2]]);
    this.forward = unit([m[8], m[9], m[10]]);
    this.down = unit(cross(this.forward, this.right));
    const t = [m[3], m[7], m[11]];
    this.position = [0, 1, 2].map(k => -(m[k] * t[0] + m[4 + k] * t[1] + m[8 + k] * t[2]));
    this.lens = camera;
    // The near plane is that of the camera until one comes nearer; mostNear: until one flies.
    this.near = this.mostNear = camera.near;
    this.distance = distance;
  }

  get pivot() { return add(this.position, this.forward, this.distance); }

  copy() { return Object.assign(Object.create(View.prototype), this); }

  // Between two views: t from 0 to 1. Returns this view itself for 1.
  towards(other, t) {
    if (t >= 1) return other.copy();
    const view = this.copy(), mix = (a, b) => a.map((x, k) => x + t * (b[k] - x));
    view.position = mix(this.position, other.position);
    view.forward = unit(mix(this.forward, other.forward));
    const down = mix(this.down, other.down);
    view.right = unit(cross(down, view.forward));
    view.down = cross(view.forward, view.right);
    view.distance = this.distance + t * (other.distance - this.distance);
    view.near = Math.min(this.near, other.near);
    const lens = { ...other.lens };
    for (const key of ["fx", "fy", "cx", "cy", "width", "height"]) {
      lens[key] = this.lens[key] + t * (other.lens[key] - this.lens[key]);
    }
    view.lens = lens;
    return view;
  }

  #turn(axis, angle) {
    for (const name of ["right", "down", "forward"]) this[name] = unit(turned(this[name], axis, angle));
  }

  // Turns by angles: to the left, around the up direction; then downwards, around the camera's right, not
  // over the poles.
  #rotate(yaw, pitch) {
    const tilt = Math.asin(Math.max(-1, Math.min(1, -dot(this.forward, this.up))));
    const least = -1.55 - tilt, most = 1.55 - tilt;
    this.#turn(this.up, yaw);
    const level = dot(this.right, this.up);
    if (Math.abs(level) < 0.3) pitch = Math.max(Math.min(0, least), Math.min(Math.max(0, most), pitch));
    this.#turn(this.right, -pitch);
  }

  orbit(yaw, pitch) {
    const pivot = this.pivot;
    this.#rotate(yaw, pitch);
    this.position = add(pivot, this.forward, -this.distance);
  }

  look(yaw, pitch) { this.#rotate(yaw, pitch); }

  // Pixels of a window of w x h to one of the lens: its whole image fits in it.
  scale(w, h) { return Math.min(w / this.lens.width, h / this.lens.height); }

  // Moves what is at the depth of the pivot by pixels of such a window.
  pan(x, y, w, h) {
    const length = this.distance / (this.lens.fx * this.scale(w, h));
    this.position = add(add(this.position, this.right, -x * length), this.down, -y * length);
  }

  // radius: of the scene. A long lens reaches farther, and no camera is too far away where it stands.
  zoom(factor, radius) {
    const pivot = this.pivot, { fx, width, height } = this.lens;
    const most = Math.max(this.distance, FARTHEST * radius * fx / Math.max(width, height));
    this.distance = Math.min(most, Math.max(this.distance * factor, NEAREST * radius));
    this.near = Math.min(this.mostNear, NEAR * this.distance);
    this.position = add(pivot, this.forward, -this.distance);
  }

  // Along right, down, forward in scene units, to anything: the near plane is as near as zooming brings the
  // pivot. Nearer ones would leave a depth buffer without precision at the distance of the scene.
  move(x, y, z, radius) {
    this.near = this.mostNear = Math.min(this.mostNear, NEAREST * radius);
    this.position = add(add(add(this.position, this.right, x), this.down, y), this.forward, z);
  }

  // The pinhole of an image of w x h pixels. dx, dy: offset of the samples from the pixels' centres.
  pinhole(w, h, dx = 0, dy = 0) {
    const lens = this.lens, s = this.scale(w, h), p = this.position;
    const rows = [this.right, this.down, this.forward].map(axis => [...axis, -dot(axis, p)]);
    return {
      rows, center: p, fx: lens.fx * s, fy: lens.fy * s, near: this.near, width: w, height: h,
      cx: w / 2 + (lens.cx - lens.width / 2) * s - dx, cy: h / 2 + (lens.cy - lens.height / 2) * s - dy,
    };
  }
}

// Pixel (x, y) and depth of a point.
export function project(pinhole, point) {
  const [x, y, z] = pinhole.rows.map(r => r[0] * point[0] + r[1] * point[1] + r[2] * point[2] + r[3]);
  return [pinhole.fx * x / z + pinhole.cx, pinhole.fy * y / z + pinhole.cy, z];
}

// Coordinates of a point in the world, as text: decimals as fine as `step`.
export function inWorld(point, origin, step) {
  const digits = Math.min(100, Math.max(0, Math.ceil(-Math.log10(step))));
  return point.map((value, k) => String(Number((origin[k] + value).toFixed(digits))));
}

// The nearest vertex of a mesh, {point, depth}, that is not nearly transparent and lies within `reach` pixels
// of a point of the image; where the mesh is cropped, of the `triangles` that are left.
export function nearestVertex({ vertices, colors, faces }, triangles, pinhole, x, y, reach) {
  const { rows: [a, b, c], fx, fy, cx, cy } = pinhole;
  const left = triangles && new Uint8Array(vertices.length / 3);
  for (const t of triangles ?? []) for (const v of faces.subarray(3 * t, 3 * t + 3)) left[v] = 1;
  let depth = Infinity, found = -1;
  for (let v = 0, i = 0; v < vertices.length / 3; v++, i += 3) {
    if (left && !left[v]) continue;
    const X = vertices[i], Y = vertices[i + 1], Z = vertices[i + 2];
    const z = c[0] * X + c[1] * Y + c[2] * Z + c[3];
    if (!(z > pinhole.near) || z >= depth || colors[4 * v + 3] < 0.2) continue;
    const dx = fx * (a[0] * X + a[1] * Y + a[2] * Z + a[3]) / z + cx - x;
    const dy = fy * (b[0] * X + b[1] * Y + b[2] * Z + b[3]) / z + cy - y;
    if (dx * dx + dy * dy < reach * reach) [depth, found] = [z, i];
  }
  return found < 0 ? null : { point: [...vertices.subarray(found, found + 3)], depth };
}
