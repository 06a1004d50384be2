// Cameras: unit vectors right, up, back (OpenGL axes) and eye in world axes, lens in pixels.

const add = (a, b, s = 1) => a.map((x, i) => x + s * b[i]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0],
];
const unit = (a) => a.map((x) => x / Math.hypot(...a));
const MOST_ELEVATION = 1.5; // radians: a turntable has no up at its pole
const NEAREST = 0.2, FARTHEST = 30; // of the eye to the pivot, in radii of the object

// Rodrigues: v turned around a unit axis.
function turned(v, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle), along = dot(axis, v) * (1 - c);
  const side = cross(axis, v);
  return v.map((x, i) => x * c + side[i] * s + axis[i] * along);
}

function turnedAround(camera, pivot, axis, angle) {
  const back = unit(turned(camera.back, axis, angle));
  // right and up again at right angles, so that rounding does not add up
  const right = unit(cross(turned(camera.up, axis, angle), back));
  const eye = add(pivot, turned(add(camera.eye, pivot, -1), axis, angle));
  return { ...camera, right, up: cross(back, right), back, eye };
}

// A turntable: yaw around the scene's up, pitch around the camera's right; radians.
export function orbit(camera, pivot, up, yaw, pitch) {
  const turn = turnedAround(camera, pivot, up, yaw);
  const elevation = Math.asin(Math.max(-1, Math.min(1, dot(turn.back, up))));
  const most = Math.max(MOST_ELEVATION, Math.abs(elevation));
  const wanted = Math.max(-most, Math.min(most, elevation + pitch));
  const axis = cross(up, turn.back); // level, so that a pitch is a change of elevation alone
  if (Math.hypot(...axis) < 1e-6) return turn;
  return turnedAround(turn, pivot, unit(axis), elevation - wanted);
}

// Moves camera and pivot so that what is at the pivot follows the pointer by (dx, dy) pixels.
export function pan(camera, pivot, dx, dy) {
  const depth = Math.max(1e-6, dot(add(camera.eye, pivot, -1), camera.back));
  const move = add(camera.right.map((x) => (-x * dx * depth) / camera.fx), camera.up, (dy * depth) / camera.fy);
  return [{ ...camera, eye: add(camera.eye, move) }, add(pivot, move)];
}

export function zoom(camera, pivot, factor, radius) {
  const away = add(camera.eye, pivot, -1), distance = Math.hypot(...away);
  const wanted = Math.max(NEAREST * radius, Math.min(FARTHEST * radius, distance * factor));
  return { ...camera, eye: add(pivot, away, wanted / distance) };
}

// (column, row, depth) of a world position.
export function project(camera, p) {
  const rel = add(p, camera.eye, -1), z = -dot(rel, camera.back);
  return [camera.cx + (camera.fx * dot(rel, camera.right)) / z, camera.cy - (camera.fy * dot(rel, camera.up)) / z, z];
}

// World position of a pixel at a depth.
export function unproject(camera, u, v, depth) {
  const x = ((u - camera.cx) / camera.fx) * depth, y = ((camera.cy - v) / camera.fy) * depth;
  return add(add(add(camera.eye, camera.right, x), camera.up, y), camera.back, -depth);
}

export function scaled(camera, factor) {
  const w = Math.round(camera.w * factor), h = Math.round(camera.h * factor);
  const sx = w / camera.w, sy = h / camera.h;
  return { ...camera, fx: camera.fx * sx, fy: camera.fy * sy, cx: camera.cx * sx, cy: camera.cy * sy, w, h };
}

export function fromFacts(facts) {
  const m = facts.transform_matrix, column = (i) => [m[0][i], m[1][i], m[2][i]];
  return {
    right: column(0), up: column(1), back: column(2), eye: column(3),
    fx: facts.fl_x, fy: facts.fl_y, cx: facts.cx, cy: facts.cy, w: facts.w, h: facts.h,
  };
}

export function toFacts(camera) {
  const rows = [0, 1, 2].map((i) => [camera.right[i], camera.up[i], camera.back[i], camera.eye[i]]);
  return {
    transform_matrix: [...rows, [0, 0, 0, 1]],
    fl_x: camera.fx, fl_y: camera.fy, cx: camera.cx, cy: camera.cy, w: camera.w, h: camera.h,
  };
}
