"use strict";
// Draws the Gaussians of #gaussians, whose bytes page.py's GAUSSIAN describes, as viewers of 3D
// Gaussian splatting do (cl/raster/footprint/gaussian.h), those far away first. Axes of a camera: x
// right, y down, z forward.

const header = JSON.parse(document.getElementById("header").textContent);
const canvas = document.querySelector("canvas");
const hint = document.querySelector("p"), unseen = document.querySelector("aside");
const isWithin = parent !== window;  // it is shown by another page
document.body.classList.toggle("within", isWithin);

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

// ---- Gaussians ----
const text = atob(document.getElementById("gaussians").textContent);
const ROW = 400, TEXELS = 5;  // Gaussians in a row of the texture that holds them; texels of one
const rows = Math.max(1, Math.ceil(header.count / ROW));
const bytes = new Uint8Array(rows * ROW * TEXELS * 8);
for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
// from the box's corner, which may be too far from the world's origin for float32
const positions = new Float32Array(3 * header.count);
const halves = new Uint16Array(bytes.buffer);
for (let i = 0; i < header.count; i++)
  for (let k = 0; k < 3; k++)
    positions[3 * i + k] = header.unit * halves[i * TEXELS * 4 + k];

// Gives a function that sorts positions by their depth along an axis, farthest first: one counting
// sort. It is text for a worker, too, so it uses nothing around it.
function makeSorter(positions) {
  const BUCKETS = 1 << 16, n = positions.length / 3;
  const depths = new Float32Array(n), keys = new Uint16Array(n);
  const starts = new Uint32Array(BUCKETS + 1);
  return (axis) => {
    const [x, y, z] = axis, order = new Uint32Array(n);
    let least = Infinity, most = -Infinity;
    for (let i = 0; i < n; i++) {
      const depth = x * positions[3 * i] + y * positions[3 * i + 1] + z * positions[3 * i + 2];
      depths[i] = depth;
      if (depth < least) least = depth;
      if (depth > most) most = depth;
    }
    const scale = (BUCKETS - 1) / Math.max(most - least, 1e-30);
    starts.fill(0);
    for (let i = 0; i < n; i++) {
      keys[i] = (most - depths[i]) * scale;
      starts[keys[i] + 1]++;
    }
    for (let b = 0; b < BUCKETS; b++) starts[b + 1] += starts[b];
    for (let i = 0; i < n; i++) order[starts[keys[i]]++] = i;
    return order;
  };
}
const sorted = makeSorter(positions);

// ---- shaders ----
const VERTEX = `#version 300 es
precision highp float;
precision highp usampler2D;
layout(location = 0) in uint row;       // of the Gaussian
uniform usampler2D gaussians;
uniform vec3 eye;                       // from the box's corner
uniform float unit, low[9], span[9], nearest, extent;
uniform vec2 logarithms;                // of deviations: the least, and the span
uniform float widened, low_pass;        // pixels^2 on the screen: in all, of what was fitted
uniform mat3 axes;                      // columns: right, down, forward
uniform vec4 focal;                     // fx, fy, cx, cy
uniform vec2 size;
out vec2 deviation;                     // from the centre, in standard deviations
flat out vec4 colour;
flat out float reach, depth;            // depth: in extents of the scene
uint at(uvec2 two[5], int k) {          // the byte k
  uint word = (k & 4) == 0 ? two[k >> 3].x : two[k >> 3].y;
  return (word >> uint(8 * (k & 3))) & 255u;
}
void main() {
  uvec2 two[5];
  for (int i = 0; i < 5; i++)
    two[i] = texelFetch(gaussians, ivec2(5u * (row % ${ROW}u) + uint(i), row / ${ROW}u), 0).xy;
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // outside
  vec3 place = unit * vec3(two[0].x & 65535u, two[0].x >> 16, two[0].y & 65535u);
  vec3 towards = place - eye, centre = towards * axes;
  if (centre.z < nearest) return;
  depth = centre.z / extent;
  vec3 own = vec3(at(two, 7), at(two, 8), at(two, 9)) / 255.0;
  own = exp(logarithms.x + logarithms.y * own);
  vec3 q = (vec3(at(two, 10), at(two, 11), at(two, 12)) - 128.0) / 240.0;
  float w = sqrt(max(0.0, 1.0 - dot(q, q)));
  // the Gaussian's axes, as long as its deviations, in those of the camera
  mat3 turn = mat3(
      1.0 - 2.0 * (q.y * q.y + q.z * q.z), 2.0 * (q.x * q.y + w * q.z), 2.0 * (q.x * q.z - w * q.y),
      2.0 * (q.x * q.y - w * q.z), 1.0 - 2.0 * (q.x * q.x + q.z * q.z), 2.0 * (q.y * q.z + w * q.x),
      2.0 * (q.x * q.z + w * q.y), 2.0 * (q.y * q.z - w * q.x), 1.0 - 2.0 * (q.x * q.x + q.y * q.y));
  mat3 form = transpose(axes) * mat3(own.x * turn[0], own.y * turn[1], own.z * turn[2]);
  mat3 by_row = transpose(form);
  vec2 across = centre.xy / centre.z;
  // far outside of the image the derivative of the projection says nothing
  vec2 most = 1.3 * max(focal.zw, size - focal.zw) / focal.xy, bent = clamp(across, -most, most);
  vec3 a = focal.x / centre.z * (by_row[0] - bent.x * by_row[2]);
  vec3 b = focal.y / centre.z * (by_row[1] - bent.y * by_row[2]);
  // the covariance on the screen, and what it was before pixels larger than the fit's widened it
  float xx = dot(a, a), yy = dot(b, b), xy = dot(a, b);
  vec3 normal = cross(a, b);
  float wide = dot(normal, normal), sum = xx + yy;
  float determinant = wide + widened * sum + widened * widened;
  float before = wide + low_pass * sum + low_pass * low_pass;
  float opacity = float(at(two, 6)) / 255.0 * sqrt(before / determinant);
  if (opacity * 255.0 < 1.0) return;
  reach = sqrt(2.0 * log(255.0 * opacity));
  float middle = 0.5 * sum + widened;
  float half_way = sqrt(max(0.0, 0.25 * (xx - yy) * (xx - yy) + xy * xy));
  float major = middle + half_way, minor = determinant / major;
  vec2 along = abs(xy) > 1e-9 * sum ? normalize(vec2(xy, major - widened - xx))
      : xx >= yy ? vec2(1.0, 0.0) : vec2(0.0, 1.0);
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  vec2 deviations = sqrt(vec2(major, minor));
  deviation = corner * reach;
  vec2 pixel = focal.xy * across + focal.zw
      + deviation.x * deviations.x * along + deviation.y * deviations.y * vec2(-along.y, along.x);
  gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0.0, 1.0);
  vec3 d = normalize(towards);
  float basis[9] = float[9](
      0.28209479, -0.48860251 * d.y, 0.48860251 * d.z, -0.48860251 * d.x,
      1.09254843 * d.x * d.y, -1.09254843 * d.y * d.z, 0.31539157 * (3.0 * d.z * d.z - 1.0),
      -1.09254843 * d.x * d.z, 0.54627422 * (d.x * d.x - d.y * d.y));
  vec3 seen = vec3(0.5);
  for (int k = 0; k < 9; k++) {
    int first = 13 + 3 * k;
    vec3 stored = vec3(at(two, first), at(two, first + 1), at(two, first + 2)) / 255.0;
    seen += basis[k] * (low[k] + span[k] * stored);
  }
  colour = vec4(max(seen, 0.0), opacity);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec2 deviation;
flat in vec4 colour;
flat in float reach, depth;
layout(location = 0) out vec4 result;
layout(location = 1) out vec4 depths;   // x: the mean depth times alpha
void main() {
  float square = dot(deviation, deviation);
  if (square > reach * reach) discard;
  float alpha = min(0.99, colour.a * exp(-0.5 * square));
  result = vec4(colour.rgb * alpha, alpha);
  depths = vec4(depth * alpha, 0.0, 0.0, alpha);
}`;
const FINISH_VERTEX = `#version 300 es
void main() {
  gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0);
}`;
// Copies the image to the canvas and adds reflections: the specular layer of cl/layers/specular.cl,
// if the Gaussians have one. Its weights are as page.py's pack_specular() orders them.
const layer = Uint8Array.from(atob(header.specular), (character) => character.charCodeAt(0));
const FINISH_FRAGMENT = `#version 300 es
precision highp float;
precision highp sampler2D;
uniform sampler2D image, depths;
uniform vec3 eye;                       // from the scene's middle, in its extents
uniform mat3 axes;
uniform vec4 focal;
uniform float height;
layout(std140) uniform Layer { vec4 weights[${Math.max(1, layer.length / 16)}]; };
out vec4 result;
vec4 hidden[8];
int next;
void take(float x) {                    // the next input of the first layer
  for (int j = 0; j < 8; j++) hidden[j] += x * weights[next + j];
  next += 8;
}
void take(vec3 d) { take(d.x); take(d.y); take(d.z); }
void encode(vec3 d, int octaves) {      // as NeRF encodes positions
  take(d);
  for (int k = 0; k < octaves; k++) {
    vec3 angle = 1.57079633 * exp2(float(k)) * d;
    take(sin(angle));
    take(cos(angle));
  }
}
void main() {
  ivec2 pixel = ivec2(gl_FragCoord.xy);
  vec4 seen = texelFetch(image, pixel, 0);
  result = vec4(seen.rgb, 1.0);
  if (${layer.length} == 0 || seen.a < 0.02) return;
  vec2 across = (vec2(gl_FragCoord.x, height - gl_FragCoord.y) - focal.zw) / focal.xy;
  vec3 direction = normalize(axes * vec3(across, 1.0));
  for (next = 0; next < 8; next++) hidden[next] = weights[next];
  take(seen.rgb);
  take(1.0 - seen.a);
  encode(direction, 4);
  encode(eye + texelFetch(depths, pixel, 0).x / seen.a * direction, 2);
  vec4 second[8];
  for (int j = 0; j < 8; j++) second[j] = weights[next + j];
  next += 8;
  for (int i = 0; i < 32; i++, next += 8) {
    float x = max(0.0, hidden[i >> 2][i & 3]);
    for (int j = 0; j < 8; j++) second[j] += x * weights[next + j];
  }
  vec4 added = weights[next++];
  for (int i = 0; i < 32; i++) added += max(0.0, second[i >> 2][i & 3]) * weights[next++];
  result.rgb += 0.5 * seen.a * added.rgb;
}`;

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

// How many of the canvas's pixels one is wide of the nearest window for which the Gaussians are made.
function magnification(camera, eye) {
  const distance = Math.hypot(...add(eye, header.centre, -1));
  const finer = header.pixel * Math.min(camera.fx, camera.fy) / Math.max(distance, 1e-9);
  return finer / Math.min(Math.max(finer, header.windows[0]), header.windows[1]);
}

function makeDrawer(gl) {
  // 8 bits would round away the many faint layers of a pixel; where half floats cannot be drawn
  // into, the canvas must do
  const deep = gl.getExtension("EXT_color_buffer_float")
    || gl.getExtension("EXT_color_buffer_half_float");
  const program = compiled(gl, VERTEX, FRAGMENT);
  const finish = compiled(gl, FINISH_VERTEX, FINISH_FRAGMENT);
  const placesOf = (used, known = {}) => (name) => known[name] ??= gl.getUniformLocation(used, name);
  const place = placesOf(program), finishPlace = placesOf(finish);
  const instances = gl.createVertexArray(), nothing = gl.createVertexArray();
  gl.bindVertexArray(instances);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.enableVertexAttribArray(0);
  gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
  gl.vertexAttribDivisor(0, 1);
  const stored = nearestTexture(gl, gl.RG32UI, ROW * TEXELS, rows);
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROW * TEXELS, rows, gl.RG_INTEGER, gl.UNSIGNED_INT,
    new Uint32Array(bytes.buffer));
  gl.useProgram(program);
  gl.uniform1f(place("unit"), header.unit);
  gl.uniform1f(place("nearest"), header.nearest);
  gl.uniform1f(place("extent"), header.extent);
  gl.uniform1fv(place("low"), header.low);
  gl.uniform1fv(place("span"), header.span);
  gl.uniform2fv(place("logarithms"), header.logarithms);
  gl.useProgram(finish);
  gl.uniform1i(finishPlace("depths"), 1);
  gl.bindBufferBase(gl.UNIFORM_BUFFER, 0, gl.createBuffer());
  gl.bufferData(gl.UNIFORM_BUFFER, layer.length ? layer : 16, gl.STATIC_DRAW);
  const target = deep ? gl.createFramebuffer() : null;
  const attachments = [gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1].slice(0, layer.length ? 2 : 1);
  let textures = [], targetSize = "", uploaded = null;

  function resize(width, height) {
    if (!deep || targetSize === `${width}x${height}`) return;
    targetSize = `${width}x${height}`;
    textures.forEach((texture) => gl.deleteTexture(texture));
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    textures = attachments.map((attachment) => {
      const texture = nearestTexture(gl, gl.RGBA16F, width, height);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, attachment, gl.TEXTURE_2D, texture, 0);
      return texture;
    });
    gl.drawBuffers(attachments);
  }

  // camera: pose (12 numbers, camera to world, by rows), fx, fy, cx, cy, width, height in pixels.
  // order: of the Gaussians
  return (camera, order) => {
    const p = camera.pose, world = [p[3], p[7], p[11]], eye = add(world, header.origin, -1);
    resize(camera.width, camera.height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.viewport(0, 0, camera.width, camera.height);
    gl.clearBufferfv(gl.COLOR, 0, [1, 1, 1, 0]);
    if (textures.length > 1) gl.clearBufferfv(gl.COLOR, 1, [0, 0, 0, 0]);
    gl.useProgram(program);
    gl.bindVertexArray(instances);
    if (uploaded !== order) gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
    uploaded = order;
    gl.bindTexture(gl.TEXTURE_2D, stored);
    gl.uniform3fv(place("eye"), eye);
    const axes = [p[0], p[4], p[8], p[1], p[5], p[9], p[2], p[6], p[10]];
    const focal = [camera.fx, camera.fy, camera.cx, camera.cy];
    gl.uniformMatrix3fv(place("axes"), false, axes);
    gl.uniform4fv(place("focal"), focal);
    gl.uniform2f(place("size"), camera.width, camera.height);
    // Gaussians look as they do in that window: what viewers widen them by grows with them, and a
    // pixel that shows several of the window's is their mean
    const square = magnification(camera, world) ** 2, fitted = header.low_pass * square;
    gl.uniform1f(place("low_pass"), fitted);
    gl.uniform1f(place("widened"), fitted + Math.max(0, 1 - square) / 12);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, header.count);
    if (!deep) return;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.BLEND);
    gl.useProgram(finish);
    gl.uniform3fv(finishPlace("eye"), scaled(add(eye, header.corner), 1 / header.extent));
    gl.uniformMatrix3fv(finishPlace("axes"), false, axes);
    gl.uniform4fv(finishPlace("focal"), focal);
    gl.uniform1f(finishPlace("height"), camera.height);
    gl.bindVertexArray(nothing);
    textures.forEach((texture, i) => {
      gl.activeTexture(gl.TEXTURE0 + i);
      gl.bindTexture(gl.TEXTURE_2D, texture);
    });
    gl.activeTexture(gl.TEXTURE0);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  };
}

// A new texture, which is bound.
function nearestTexture(gl, format, width, height) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  return texture;
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

// By how many degrees a look is beyond those that were photographed.
function beyond(look) {
  const up = header.up, ahead = header.ahead, degrees = 180 / Math.PI;
  const towards = unit(add(look.eye, header.centre, -1));
  const rise = degrees * Math.asin(Math.max(-1, Math.min(1, dot(towards, up))));
  const azimuth = Math.atan2(dot(towards, cross(up, ahead)), dot(towards, ahead));
  const sectors = header.photographed, count = sectors.length;
  const at = (azimuth / (2 * Math.PI) + 1) * count, first = Math.floor(at), part = at - first;
  const [low, high, aside] = sectors[first % count].map(
    (value, i) => (1 - part) * value + part * sectors[(first + 1) % count][i]);
  return Math.max(low - rise, rise - high, aside * Math.cos(rise / degrees), 0);
}

// Shows the less of the model the further the window's look is beyond the photographs.
const FREE = 10, FADED = 30, FAINT = 0.1;  // degrees, degrees, opacity
function fade() {
  const isFixed = look.w && look.h;  // for a script or a test, which want what there is
  const part = isFixed ? 0 : Math.min(1, Math.max(0, (beyond(look) - FREE) / (FADED - FREE)));
  canvas.style.opacity = 1 - (1 - FAINT) * part;
  unseen.style.opacity = Math.max(0, 2 * part - 1);
}

const gl = canvas.getContext("webgl2", { antialias: false, alpha: false });
if (!gl) hint.textContent = "This page needs WebGL2, which this browser or device does not have.";
let draw = gl && makeDrawer(gl);
// a phone may take the context away while the page is not seen; unless this is told, it stays lost
canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
canvas.addEventListener("webglcontextrestored", () => {
  draw = makeDrawer(gl);
  show();
});
const FAST = 20, SLOW = 40, COARSEST = 0.4, REST = 200;  // milliseconds, but for COARSEST
let look = lookOf(location.hash), waiting = false, rests = 0;
let order = null, wanted = null, sortedAxis = "";  // of the last sort; the next axis, and this one
let fineness = 1;  // of the pixels of a movement's frames, each way

const axisOf = (camera) => [2, 6, 10].map((i) => camera.pose[i]);

// The canvas is cleared by a size that is set, even where it is the one that it has.
function resizeCanvas(camera, width, height) {
  if (canvas.width !== camera.width) canvas.width = camera.width;
  if (canvas.height !== camera.height) canvas.height = camera.height;
  canvas.style.width = width;
  canvas.style.height = height;
}

// Draws at once. camera: as cameraOf gives it.
function setCamera(camera) {
  resizeCanvas(camera, "", "");
  order = sorted(axisOf(camera));
  sortedAxis = String(axisOf(camera));
  draw(camera, order);
}

// The camera of the window, in pixels of which `fine` are one of the screen's each way.
function windowCamera(fine) {
  const fixed = look.w && look.h, ratio = fixed ? 1 : fine * (window.devicePixelRatio || 1);
  const width = fixed ? look.w : innerWidth, height = fixed ? look.h : innerHeight;
  document.body.classList.toggle("bare", Boolean(fixed));
  return [cameraOf(look, Math.round(width * ratio), Math.round(height * ratio)), width, height];
}

// Draws the window as finely as it can be.
function show() {
  if (!gl) return;
  const [camera, width, height] = windowCamera(1);
  setCamera(camera);
  resizeCanvas(camera, `${width}px`, `${height}px`);
  fade();
}

// Keeps the look in the address, and tells a page around this one, which may load it again.
function remember() {
  history.replaceState(null, "", hashOf(look));
  if (isWithin) parent.postMessage(location.hash, "*");
}

// Draws a movement, in the order that the worker found last, and as coarsely as the machine needs.
function frame(now) {
  waiting = false;
  if (!gl) return;
  const [camera, width, height] = windowCamera(fineness);
  resizeCanvas(camera, `${width}px`, `${height}px`);
  fade();
  sortSoon(axisOf(camera));
  draw(camera, order);
  requestAnimationFrame((then) => {  // when the machine is ready for another one
    if (then - now > SLOW) fineness = Math.max(COARSEST, 0.8 * fineness);
    else if (then - now < FAST) fineness = Math.min(1, 1.05 * fineness);
  });
  clearTimeout(rests);
  rests = setTimeout(() => {
    show();
    if (!fingers.size) remember();
  }, REST);
}

// Has a worker sort, the newest axis after the one it is at; where there is none, this thread does.
let worker = null, isSorting = false;
try {
  const source = `let sorted = null; onmessage = ({ data }) => {
    if (!sorted) sorted = (${makeSorter})(data); else postMessage(sorted(data)); };`;
  worker = new Worker(URL.createObjectURL(new Blob([source], { type: "text/javascript" })));
  worker.postMessage(positions);
  worker.onmessage = ({ data }) => {
    isSorting = false;
    order = data;
    if (wanted) sortSoon(wanted);
    soon();
  };
  worker.onerror = () => { worker = null; isSorting = false; };
} catch { worker = null; }

function sortSoon(axis) {
  wanted = isSorting ? axis : null;
  if (isSorting) return;
  if (!worker) order = sorted(axis);
  else if (String(axis) !== sortedAxis) {
    isSorting = true;
    sortedAxis = String(axis);
    worker.postMessage(axis);
  }
}

function soon() {
  if (!waiting) requestAnimationFrame(frame);
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

// Never nearer than the Gaussians that are drawn: at the target itself, there is no direction.
function approach(factor) {
  const offset = add(look.eye, look.target, -1), least = header.nearest / Math.hypot(...offset);
  look.eye = add(look.target, offset, Math.max(factor, Math.min(1, least)));
}

// A finger within another page may be about to scroll that, which a browser tells after some pixels.
const SLOP = 16;
let isTurning = false;
const fingers = new Map();
canvas.addEventListener("pointerdown", (event) => {
  fingers.set(event.pointerId, [event.clientX, event.clientY]);
  canvas.setPointerCapture(event.pointerId);
  isTurning = !isWithin || event.pointerType !== "touch" || fingers.size > 1;
  if (isWithin) parent.postMessage("held", "*");
});
canvas.addEventListener("pointermove", (event) => {
  const before = fingers.get(event.pointerId);
  if (!before) return;
  const now = [event.clientX, event.clientY], [dx, dy] = add(now, before, -1);
  if (!isTurning && Math.hypot(dx, dy) < SLOP) return;
  fingers.set(event.pointerId, now);
  if (!isTurning) {
    isTurning = true;
    return;
  }
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
  remember();
};
// two fingers are the model's, also where one scrolls the page around it
canvas.addEventListener("touchmove", (event) => {
  if (event.touches.length > 1) event.preventDefault();
}, { passive: false });
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
  if (event.ctrlKey || event.metaKey || event.altKey) return;  // the browser's own
  if (STEPS[event.key]) turn(...STEPS[event.key]);
  else if (event.key === "+" || event.key === "-") approach(event.key === "+" ? 0.9 : 1 / 0.9);
  else if (event.key === "r" || event.key === "R") back();
  else return;
  event.preventDefault();  // a page around this one would scroll
  soon();
});
addEventListener("hashchange", () => { look = lookOf(location.hash); soon(); });
addEventListener("resize", soon);
window.ppcl = { setCamera, show, sorted, positions, canvas };
show();
