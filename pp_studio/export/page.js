"use strict";
// Draws the points of #points as pp-cl's rasteriser does (cl/raster/footprint/soft.h, alpha.cl), with
// colours from harmonics instead of the network. Axes of a camera: x right, y down, z forward.

const header = JSON.parse(document.getElementById("header").textContent);
const canvas = document.querySelector("canvas");
const hint = document.querySelector("p");

// ---- vectors ----
const add = (a, b, s = 1) => a.map((x, i) => x + s * b[i]);
const dot = (a, b) => a.reduce((sum, x, i) => sum + x * b[i], 0);
const scaled = (a, s) => a.map((x) => x * s);
const unit = (a) => scaled(a, 1 / Math.hypot(...a));
const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
// a turned about a unit axis
const turned = (a, axis, angle) => {
  const c = Math.cos(angle), s = Math.sin(angle);
  return add(add(scaled(a, c), cross(axis, a), s), axis, dot(axis, a) * (1 - c));
};

// ---- points ----
const text = atob(document.getElementById("points").textContent);
const bytes = new Uint8Array(header.count * header.stride);
for (let i = 0; i < bytes.length; i++) bytes[i] = text.charCodeAt(i);
// from the grid's origin, which may be too far from the world's for float32
const positions = new Float32Array(3 * header.count);
const words = new Uint16Array(bytes.buffer);
for (let i = 0; i < header.count; i++)
  for (let k = 0; k < 3; k++)
    positions[3 * i + k] = header.unit * words[i * header.stride / 2 + k];

const BUCKETS = 1 << 16;
const order = new Uint32Array(header.count);
const keys = new Uint16Array(header.count);
const starts = new Uint32Array(BUCKETS + 1);

// Fills order with the points, farthest from the eye, which is relative to the grid's origin, first:
// one counting sort of the distances.
function sortPoints(eye) {
  const n = header.count, distances = new Float32Array(n);
  let least = Infinity, most = 0;
  for (let i = 0; i < n; i++) {
    const x = positions[3 * i] - eye[0], y = positions[3 * i + 1] - eye[1];
    const z = positions[3 * i + 2] - eye[2], t = Math.sqrt(x * x + y * y + z * z);
    distances[i] = t;
    if (t < least) least = t;
    if (t > most) most = t;
  }
  const scale = (BUCKETS - 1) / Math.max(most - least, 1e-30);
  starts.fill(0);
  for (let i = 0; i < n; i++) {
    keys[i] = (most - distances[i]) * scale;
    starts[keys[i] + 1]++;
  }
  for (let b = 0; b < BUCKETS; b++) starts[b + 1] += starts[b];
  for (let i = 0; i < n; i++) order[starts[keys[i]]++] = i;
}

// No network fills the gaps between points that pixels finer than the training's show. So a
// footprint keeps the size in world units that it has in the finest training view, and grows up to
// this factor. At the training's own pixels all is as it was fitted.
const GROWN = 1.6;

// How many times larger the camera shows the object than the training views do, at least 1.
function magnification(camera, eye) {
  const distance = Math.hypot(...add(eye, header.centre, -1));
  return Math.max(1, header.pixel * Math.min(camera.fx, camera.fy) / Math.max(distance, 1e-9));
}

// ---- shaders ----
const VERTEX = `#version 300 es
precision highp float;
layout(location = 0) in vec3 place;     // in units
layout(location = 1) in float opacity;
// coefficients, three colours of each function
layout(location = 2) in vec4 b0;
layout(location = 3) in vec4 b1;
layout(location = 4) in vec4 b2;
layout(location = 5) in vec4 b3;
layout(location = 6) in vec4 b4;
layout(location = 7) in vec4 b5;
layout(location = 8) in vec4 b6;        // w: log of the radius over the uniform one, plus 0.5
uniform vec3 eye;                       // from the grid's origin
uniform float unit, radius, nearest, low[9], span[9];
uniform float least;                    // half the width of the smallest footprint, in pixels
uniform float grown;                    // footprints that fill the gaps between points
uniform mat3 axes;                      // columns: right, down, forward
uniform vec4 focal;                     // fx, fy, cx, cy
uniform vec2 size;
flat out vec3 centre;
flat out float t, reach;
flat out vec4 colour;
vec3 value(int k, vec3 stored) { return low[k] + span[k] * stored; }
void main() {
  vec3 towards = unit * place - eye;
  centre = towards * axes;
  t = length(towards);
  float own = radius * exp(b6.w - 0.5);
  reach = grown * max(own, least * t / min(focal.x, focal.y));
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // outside
  gl_PointSize = 1.0;
  float scale = centre.z * centre.z - reach * reach;
  if (t - own < nearest || centre.z <= reach) return;
  vec2 at = focal.xy * centre.xy / centre.z + focal.zw;
  // the ellipse that the footprint covers, and how far its middle is from the centre's pixel
  vec2 half_width = focal.xy * reach * sqrt(centre.xy * centre.xy + scale) / scale;
  vec2 aside = abs(focal.xy * centre.xy * (centre.z / scale - 1.0 / centre.z));
  gl_PointSize = 2.0 * max(half_width.x + aside.x, half_width.y + aside.y) + 1.0;
  gl_Position = vec4(2.0 * at.x / size.x - 1.0, 1.0 - 2.0 * at.y / size.y, 0.0, 1.0);
  vec3 d = towards / t;
  colour = vec4(
      value(0, b0.xyz) + value(1, vec3(b0.w, b1.xy)) * d.x
          + value(2, vec3(b1.zw, b2.x)) * d.y + value(3, b2.yzw) * d.z
          + value(4, b3.xyz) * d.x * d.y + value(5, vec3(b3.w, b4.xy)) * d.y * d.z
          + value(6, vec3(b4.zw, b5.x)) * d.x * d.z
          + value(7, b5.yzw) * (3.0 * d.z * d.z - 1.0)
          + value(8, b6.xyz) * (d.x * d.x - d.y * d.y),
      opacity);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
uniform vec4 focal;
uniform vec2 size;
flat in vec3 centre;
flat in float t, reach;
flat in vec4 colour;
out vec4 result;
void main() {
  vec2 pixel = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y);
  vec3 ray = normalize(vec3((pixel - focal.zw) / focal.xy, 1.0));
  float falloff = 1.0 - length(centre - t * ray) / reach;
  if (falloff <= 0.0) discard;
  float alpha = colour.a * falloff;
  result = vec4(colour.rgb * alpha, alpha);
}`;
const COPY_VERTEX = `#version 300 es
void main() {
  gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0);
}`;
const COPY_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D image;
out vec4 result;
void main() { result = vec4(texelFetch(image, ivec2(gl_FragCoord.xy), 0).rgb, 1.0); }`;

function compiled(gl, ...sources) {
  const program = gl.createProgram();
  [gl.VERTEX_SHADER, gl.FRAGMENT_SHADER].forEach((kind, i) => {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, sources[i]);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw gl.getShaderInfoLog(shader);
  });
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw gl.getProgramInfoLog(program);
  return program;
}

function makeDrawer(gl) {
  // 8 bits would round away the many faint layers of a pixel; where half floats cannot be drawn
  // into, the canvas must do
  const deep = gl.getExtension("EXT_color_buffer_float")
    || gl.getExtension("EXT_color_buffer_half_float");
  const program = compiled(gl, VERTEX, FRAGMENT), copy = compiled(gl, COPY_VERTEX, COPY_FRAGMENT);
  const place = (name) => gl.getUniformLocation(program, name);
  const points = gl.createVertexArray(), nothing = gl.createVertexArray();
  gl.bindVertexArray(points);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, bytes, gl.STATIC_DRAW);
  const attribute = (index, count, type, normalized, offset) => {
    gl.enableVertexAttribArray(index);
    gl.vertexAttribPointer(index, count, type, normalized, header.stride, offset);
  };
  attribute(0, 3, gl.UNSIGNED_SHORT, false, 0);
  attribute(1, 1, gl.UNSIGNED_SHORT, true, 6);
  for (let i = 0; i < 7; i++) attribute(2 + i, 4, gl.UNSIGNED_BYTE, true, 8 + 4 * i);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.useProgram(program);
  gl.uniform1fv(place("low"), header.low);
  gl.uniform1fv(place("span"), header.span);
  for (const name of ["unit", "radius", "nearest"]) gl.uniform1f(place(name), header[name]);
  const target = deep ? gl.createFramebuffer() : null;
  let texture = null, targetSize = "";

  function resize(width, height) {
    if (!deep || targetSize === `${width}x${height}`) return;
    targetSize = `${width}x${height}`;
    gl.deleteTexture(texture);
    texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, width, height);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.framebufferTexture2D(
      gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
  }

  // camera: pose (12 numbers, camera to world, by rows), fx, fy, cx, cy, width, height in pixels
  return (camera) => {
    const p = camera.pose, world = [p[3], p[7], p[11]], eye = add(world, header.origin, -1);
    sortPoints(eye);
    resize(camera.width, camera.height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.viewport(0, 0, camera.width, camera.height);
    gl.clearColor(1, 1, 1, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(program);
    gl.bindVertexArray(points);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
    gl.uniform3fv(place("eye"), eye);
    gl.uniformMatrix3fv(
      place("axes"), false, [p[0], p[4], p[8], p[1], p[5], p[9], p[2], p[6], p[10]]);
    gl.uniform4f(place("focal"), camera.fx, camera.fy, camera.cx, camera.cy);
    gl.uniform2f(place("size"), camera.width, camera.height);
    const larger = magnification(camera, world);
    gl.uniform1f(place("least"), 0.75 * larger);
    gl.uniform1f(place("grown"), Math.min(larger, GROWN));
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawElements(gl.POINTS, header.count, gl.UNSIGNED_INT, 0);
    if (!deep) return;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.BLEND);
    gl.useProgram(copy);
    gl.bindVertexArray(nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  };
}

// ---- cameras ----
// A look: eye, target and up in world axes, fov in degrees across the shorter side, and the size of
// the image where it is not that of the window.
const first = { eye: header.eye, target: header.centre, up: header.up, fov: header.fov };

function cameraOf(look, width, height) {
  const forward = unit(add(look.target, look.eye, -1));
  const right = unit(cross(forward, look.up)), down = cross(forward, right);
  const focal = Math.min(width, height) / 2 / Math.tan(look.fov * Math.PI / 360);
  const pose = [0, 1, 2].flatMap((i) => [right[i], down[i], forward[i], look.eye[i]]);
  return { pose, fx: focal, fy: focal, cx: width / 2, cy: height / 2, width, height };
}

// The look of "#eye=x,y,z&target=x,y,z&up=x,y,z&fov=degrees&w=pixels&h=pixels", all of which may
// be missing or broken.
function lookOf(hash) {
  const given = new URLSearchParams(hash.replace(/^#/, "")), look = { ...first };
  for (const name of ["eye", "target", "up"]) {
    const numbers = (given.get(name) || "").split(",").map(parseFloat);
    if (numbers.length === 3 && numbers.every(Number.isFinite)) look[name] = numbers;
  }
  for (const name of ["fov", "w", "h"]) {
    const number = parseFloat(given.get(name));
    if (number > 0 && number < (name === "fov" ? 170 : 8192)) look[name] = number;
  }
  const towards = add(look.target, look.eye, -1);
  const usable = Math.hypot(...cross(towards, look.up)) > 1e-9;
  return usable ? look : { ...look, ...first };
}

function hashOf(look) {
  const list = (a) => a.map((x) => +x.toPrecision(12)).join(",");
  return `#eye=${list(look.eye)}&target=${list(look.target)}&up=${list(look.up)}&fov=${look.fov}`;
}

const gl = canvas.getContext("webgl2", { antialias: false, alpha: false });
if (!gl) hint.textContent = "This page needs WebGL2, which this browser or device does not have.";
const draw = gl && makeDrawer(gl);
let look = lookOf(location.hash), waiting = false;

// Draws at once. camera: as cameraOf gives it.
function setCamera(camera) {
  canvas.width = camera.width;
  canvas.height = camera.height;
  canvas.style.width = canvas.style.height = "";
  draw(camera);
}

function show() {
  waiting = false;
  if (!gl) return;
  const fixed = look.w && look.h, ratio = fixed ? 1 : window.devicePixelRatio || 1;
  const width = fixed ? look.w : innerWidth, height = fixed ? look.h : innerHeight;
  document.body.classList.toggle("bare", Boolean(fixed));
  setCamera(cameraOf(look, Math.round(width * ratio), Math.round(height * ratio)));
  canvas.style.width = `${width}px`;
  canvas.style.height = `${height}px`;
}

function soon() {
  if (!waiting) requestAnimationFrame(show);
  waiting = true;
}

// ---- mouse, fingers, keys ----
function turn(dx, dy) {
  const offset = add(look.eye, look.target, -1), up = unit(look.up);
  let moved = turned(offset, up, -dx);
  const level = Math.asin(Math.max(-1, Math.min(1, dot(unit(moved), up))));
  const rise = Math.max(-1.5, Math.min(1.5, level + dy)) - level;  // never over the pole
  moved = turned(moved, unit(cross(moved, up)), rise);
  look.eye = add(look.target, moved);
}

function move(dx, dy) {
  const p = cameraOf(look, 1, 1).pose;
  const world = 2 * Math.tan(look.fov * Math.PI / 360)
    * Math.hypot(...add(look.eye, look.target, -1)) / Math.min(innerWidth, innerHeight);
  const shift = [0, 1, 2].map((i) => -world * (p[4 * i] * dx + p[4 * i + 1] * dy));
  look.eye = add(look.eye, shift);
  look.target = add(look.target, shift);
}

function approach(factor) {
  look.eye = add(look.target, add(look.eye, look.target, -1), factor);
}

const fingers = new Map();
canvas.addEventListener("pointerdown", (event) => {
  fingers.set(event.pointerId, [event.clientX, event.clientY]);
  canvas.setPointerCapture(event.pointerId);
});
canvas.addEventListener("pointermove", (event) => {
  const before = fingers.get(event.pointerId);
  if (!before) return;
  const now = [event.clientX, event.clientY], [dx, dy] = add(now, before, -1);
  fingers.set(event.pointerId, now);
  if (fingers.size === 2) {
    const [other] = [...fingers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
    move(dx / 2, dy / 2);
    approach(Math.hypot(...add(before, other, -1)) / Math.max(Math.hypot(...add(now, other, -1)), 1));
  } else if (event.shiftKey || event.buttons & 6) move(dx, dy);
  else turn(dx / 200, dy / 200);
  soon();
});
const released = (event) => {
  fingers.delete(event.pointerId);
  history.replaceState(null, "", hashOf(look));
};
canvas.addEventListener("pointerup", released);
canvas.addEventListener("pointercancel", released);
canvas.addEventListener("contextmenu", (event) => event.preventDefault());
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  approach(Math.exp(Math.max(-100, Math.min(100, event.deltaY)) / 500));
  soon();
}, { passive: false });
const back = () => { look = { ...first }; soon(); };
canvas.addEventListener("dblclick", back);
const STEPS = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
addEventListener("keydown", (event) => {
  if (STEPS[event.key]) turn(...STEPS[event.key]);
  else if (event.key === "+" || event.key === "-") approach(event.key === "+" ? 0.9 : 1 / 0.9);
  else if (event.key === "r" || event.key === "R") back();
  else return;
  soon();
});
addEventListener("hashchange", () => { look = lookOf(location.hash); soon(); });
addEventListener("resize", soon);
window.ppcl = { setCamera, show, sortPoints, order, positions, canvas };
show();
