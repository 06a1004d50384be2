import { fromFacts, orbit, pan, project, zoom } from "./camera.js";
import { drawFrustums, frustumAt, frustums } from "./frustums.js";

const RADIANS_PER_PIXEL = 0.008, ZOOM_PER_PIXEL = 0.0012, CLICK = 5, NEAR_DOT = 12; // pixels
const OVERVIEW = 2, RAISED = 0.4; // distance, of the farthest camera's; radians above the first one
const LENS = 0.9; // focal length, of the shorter side: wide enough to see all cameras from there
const LEAST_SIDE = 1e-3; // of a box, in radii
const AXES = ["x", "y", "z"];
const $ = (id) => document.getElementById(id);

let scene = null, points = null, colours = null;
let camera = null, pivot = null, around = null;
let box = null, isGiven = false, dropped = new Set(), chosen = 0;
let held = null, hovered = null, waiting = false;

const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));

async function load() {
  const response = await fetch("scene.json");
  if (!response.ok) { say(await response.text(), true); return; }
  scene = await response.json();
  points = new Float32Array(bytes(scene.points).buffer);
  const rgb = bytes(scene.colours);
  colours = Array.from({ length: rgb.length / 3 }, (_, i) => `rgb(${rgb.subarray(3 * i, 3 * i + 3).join()})`);
  take();
  $("name").textContent = scene.name;
  $("views").replaceChildren(...scene.views.map((view) => new Option(view.name)));
  reset();
  choose(0);
}

// Box and dropped views as the server has them.
function take() {
  box = scene.box.map((corner) => [...corner]);
  isGiven = scene.is_given;
  dropped = new Set(scene.views.flatMap((view, i) => (view.dropped ? [i] : [])));
}

const middle = () => AXES.map((_, a) => (box[0][a] + box[1][a]) / 2);

function reset() {
  const size = Math.hypot(...AXES.map((_, a) => box[1][a] - box[0][a]));
  around = { radius: size / 2, views: scene.views };
  pivot = middle();
  const away = (eye) => Math.hypot(...AXES.map((_, a) => eye[a] - pivot[a]));
  const eyes = scene.views.map((view) => fromFacts(view.camera).eye), first = fromFacts(scene.views[0].camera);
  const focal = LENS * Math.min(first.w, first.h);
  camera = orbit({ ...first, fx: focal, fy: focal }, pivot, scene.up, 0, RAISED);
  camera = zoom(camera, pivot, (OVERVIEW * Math.max(...eyes.map(away))) / Math.max(away(camera.eye), 1e-9), around.radius);
  changed();
}

// ---- drawing

function changed() {
  showTexts();
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => { waiting = false; draw(); });
}

// The camera for the stage: its lens covers the shorter side as the photograph's covered its own.
function atStage() {
  const { clientWidth: w, clientHeight: h } = $("stage"), scale = Math.min(w, h) / Math.min(camera.w, camera.h);
  return { ...camera, fx: camera.fx * scale, fy: camera.fy * scale, cx: w / 2, cy: h / 2, w, h };
}

function draw() {
  const at = atStage(), canvas = $("picture"), ratio = window.devicePixelRatio || 1;
  canvas.width = at.w * ratio;
  canvas.height = at.h * ratio;
  Object.assign(canvas.style, { position: "absolute", width: `${at.w}px`, height: `${at.h}px` });
  const g = canvas.getContext("2d");
  g.scale(ratio, ratio);
  for (let i = 0; i < colours.length; i++) {
    const [x, y, z] = project(at, points.subarray(3 * i, 3 * i + 3));
    if (z <= 0) continue;
    g.fillStyle = colours[i];
    g.fillRect(x - 1, y - 1, 2, 2);
  }
  drawBox(g, at);
  const found = frustums(around, at, 1), only = (want) => found.map((f, i) => (want(i) ? f : null));
  drawFrustums(g, only((i) => !dropped.has(i) && i !== chosen), hovered);
  drawFrustums(g, only((i) => dropped.has(i) && i !== chosen), hovered, "#d84848a0");
  drawFrustums(g, only((i) => i === chosen), chosen);
  document.body.dataset.drawn = Number(document.body.dataset.drawn || 0) + 1;
}

function drawBox(g, at) {
  const corners = Array.from({ length: 8 }, (_, n) => project(at, AXES.map((_, a) => box[(n >> a) & 1][a])));
  g.strokeStyle = "#ff8a1f";
  g.setLineDash(isGiven ? [] : [5, 5]);
  g.beginPath();
  for (let n = 0; n < 8; n++) {
    for (let a = 0; a < 3; a++) {
      const m = n | (1 << a);
      if (m === n || corners[n][2] <= 0 || corners[m][2] <= 0) continue;
      g.moveTo(...corners[n].slice(0, 2));
      g.lineTo(...corners[m].slice(0, 2));
    }
  }
  g.stroke();
  g.setLineDash([]);
  g.fillStyle = "#ff8a1f";
  for (const { place } of dots(at)) {
    g.beginPath();
    g.arc(place[0], place[1], 5, 0, 2 * Math.PI);
    g.fill();
  }
}

// The middles of the box's sides that are ahead of the camera.
function dots(at) {
  const found = [];
  for (let side = 0; side < 2; side++) {
    for (let axis = 0; axis < 3; axis++) {
      const world = middle();
      world[axis] = box[side][axis];
      const place = project(at, world);
      if (place[2] > 0) found.push({ side, axis, world, place });
    }
  }
  return found;
}

function showTexts() {
  const count = scene.views.length - dropped.size;
  $("status").textContent = `${count} of ${scene.views.length} views, ${colours.length} points shown, box ${isGiven ? "given" : "suggested"}`;
  $("drop").ariaPressed = dropped.has(chosen);
  $("unset").disabled = !isGiven;
  scene.views.forEach((view, i) => {
    const text = dropped.has(i) ? `${view.name} (dropped)` : view.name;
    if ($("views").options[i].text !== text) $("views").options[i].text = text;
  });
  for (const input of document.querySelectorAll("#box input")) {
    if (input !== document.activeElement) input.value = short(box[input.dataset.side][input.dataset.axis]);
  }
}

const short = (x) => Number(x.toPrecision(5)).toString();

function say(line, wrong = false) {
  $("message").textContent = line;
  $("message").classList.toggle("wrong", wrong);
}

// ---- changes

async function save() {
  const names = [...dropped].map((i) => scene.views[i].name);
  const body = JSON.stringify({ box: isGiven ? box : null, dropped: names });
  let response = null;
  try {
    response = await fetch("edits", { method: "POST", body });
  } catch {
    say("The viewer has ended; nothing was written.", true);
    return;
  }
  if (response.ok) {
    scene.views.forEach((view, i) => { view.dropped = dropped.has(i); });
    Object.assign(scene, { box: box.map((corner) => [...corner]), is_given: isGiven });
    say(`written to ${scene.file}`);
    document.body.dataset.saved = Number(document.body.dataset.saved || 0) + 1;
  } else { // what the server has stays
    say(await response.text(), true);
    take();
  }
  changed();
}

function moveSide(side, axis, value) {
  const least = LEAST_SIDE * around.radius;
  box[side][axis] = side ? Math.max(value, box[0][axis] + least) : Math.min(value, box[1][axis] - least);
  isGiven = true;
  changed();
}

function choose(index) {
  chosen = index;
  $("views").selectedIndex = index;
  const image = $("photograph");
  image.src = `photograph/${index}`;
  image.hidden = false;
  image.style.width = "100%";
  image.alt = scene.views[index].name;
  changed();
}

function toggleDropped() {
  if (!dropped.delete(chosen)) dropped.add(chosen);
  save();
}

// ---- pointer and keys

const pointers = new Map();
let before = null, travelled = 0;

function gripOf() {
  const all = [...pointers.values()], n = all.length;
  const x = all.reduce((sum, p) => sum + p.clientX, 0) / n, y = all.reduce((sum, p) => sum + p.clientY, 0) / n;
  return { n, x, y, spread: n > 1 ? Math.hypot(all[0].clientX - all[1].clientX, all[0].clientY - all[1].clientY) : 0 };
}

const placeOf = (event) => {
  const at = $("stage").getBoundingClientRect();
  return [event.clientX - at.left, event.clientY - at.top];
};

function dotAt(event) {
  const [x, y] = placeOf(event);
  return dots(atStage()).find(({ place }) => Math.hypot(x - place[0], y - place[1]) < NEAR_DOT) || null;
}

const viewAt = (event) => frustumAt(frustums(around, atStage(), 1), ...placeOf(event));

function onDown(event) {
  if (!scene) return;
  $("stage").setPointerCapture(event.pointerId);
  if (!pointers.size) { travelled = 0; held = dotAt(event); }
  pointers.set(event.pointerId, event);
  before = gripOf();
}

function onMove(event) {
  if (!scene) return;
  if (!pointers.has(event.pointerId)) {
    hovered = viewAt(event);
    $("caption").textContent = hovered === null ? "" : scene.views[hovered].name;
    $("stage").classList.toggle("over", hovered !== null || dotAt(event) !== null);
    changed();
    return;
  }
  pointers.set(event.pointerId, event);
  const grip = gripOf(), dx = grip.x - before.x, dy = grip.y - before.y;
  travelled += Math.abs(dx) + Math.abs(dy) + Math.abs(grip.spread - before.spread);
  if (travelled > CLICK && grip.n === before.n) {
    const at = atStage();
    if (held) pull(at, dx, dy);
    else if (grip.n > 1 || event.buttons & 6 || event.shiftKey) {
      [camera, pivot] = pan(camera, pivot, (dx * camera.fx) / at.fx, (dy * camera.fy) / at.fy);
      if (grip.n > 1) camera = zoom(camera, pivot, before.spread / Math.max(1, grip.spread), around.radius);
    } else camera = orbit(camera, pivot, scene.up, -dx * RADIANS_PER_PIXEL, dy * RADIANS_PER_PIXEL);
    changed();
  }
  before = grip;
}

// Moves the held side along its axis by what its dot moves on the screen.
function pull(at, dx, dy) {
  const { side, axis } = held, world = middle();
  world[axis] = box[side][axis];
  const from = project(at, world), unit = 0.01 * around.radius;
  world[axis] += unit;
  const to = project(at, world), d = [to[0] - from[0], to[1] - from[1]], square = d[0] ** 2 + d[1] ** 2;
  if (square < 1e-4) return; // it points at the eye
  moveSide(side, axis, box[side][axis] + (unit * (dx * d[0] + dy * d[1])) / square);
}

function onUp(event) {
  if (!pointers.delete(event.pointerId)) return;
  before = pointers.size ? gripOf() : null;
  if (pointers.size) return;
  const moved = travelled > CLICK;
  if (held && moved) save();
  else if (!moved && event.type === "pointerup") {
    const index = viewAt(event);
    if (index !== null) choose(index);
  }
  held = null;
}

const stage = $("stage");
stage.addEventListener("pointerdown", onDown);
stage.addEventListener("pointermove", onMove);
stage.addEventListener("pointerup", onUp);
stage.addEventListener("pointercancel", onUp);
stage.addEventListener("contextmenu", (event) => event.preventDefault());
stage.addEventListener("wheel", (event) => {
  event.preventDefault();
  if (!scene) return;
  const lines = event.deltaMode ? 30 : 1;
  camera = zoom(camera, pivot, Math.exp(Math.max(-400, Math.min(400, event.deltaY * lines)) * ZOOM_PER_PIXEL), around.radius);
  changed();
}, { passive: false });
window.addEventListener("resize", () => scene && changed());
window.addEventListener("keydown", (event) => {
  if (!scene || event.ctrlKey || event.metaKey || event.altKey || event.target.matches("select, input")) return;
  if (event.key === "d") toggleDropped();
  else if (event.key === "r") reset();
});
$("views").addEventListener("change", (event) => choose(event.target.selectedIndex));
$("drop").addEventListener("click", toggleDropped);
$("keep").addEventListener("click", () => { dropped.clear(); save(); });
$("reset").addEventListener("click", reset);
$("unset").addEventListener("click", async () => { isGiven = false; await save(); await load(); });
$("box").append(...[0, 1].flatMap((side) => AXES.map((name, axis) => {
  const label = document.createElement("label"), input = document.createElement("input");
  Object.assign(input, { type: "number", step: "any", id: `${name}${side}` });
  Object.assign(input.dataset, { side, axis });
  input.addEventListener("change", () => {
    if (!Number.isFinite(input.valueAsNumber)) return;
    moveSide(side, axis, input.valueAsNumber);
    save();
  });
  label.append(`${side ? "to" : "from"} ${name} `, input);
  return label;
})));
load();
