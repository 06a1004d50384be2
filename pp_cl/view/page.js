import { fromFacts, orbit, pan, scaled, toFacts, zoom } from "./camera.js";
import { drawCurve } from "./curve.js";
import { drawFrustums, frustumAt, frustums } from "./frustums.js";

const RADIANS_PER_PIXEL = 0.008, ZOOM_PER_PIXEL = 0.0012, CLICK = 5;
const $ = (id) => document.getElementById(id);
const STILL = 180; // ms without movement until the full resolution is asked for
const RECONNECT = 2000, NOTE = 4000; // ms
const SLIDERS = ["early_stop", "kept", "exposure"];
const CUBIC = ["early_stop"]; // most of their effect is near 0: value = 0.5 position^3
const MOST_SIDE = 4096, MOST_PIXELS = 2 ** 23; // of a picture, as messages.py
const OWN_CAMERA = ["error", "photograph"];

let socket = null;
let facts = null; // of the run
let around = null; // centre, radius, up, first camera, training views
let camera = null, pivot = null, loads = 0;
let number = 0, shownNumber = 0, shownCamera = null, shownView = null;
let photograph = false, moving = false, asked = false, stillTimer = 0, noteTimer = 0;
let rows = []; // of the log

// ---- the connection

function connect() {
  const address = new URL("socket", location.href);
  address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
  socket = new WebSocket(address);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => { say(""); loads = 0; };
  socket.onmessage = (event) => (typeof event.data === "string" ? take(JSON.parse(event.data)) : takeFrame(event.data));
  socket.onclose = () => {
    $("status").textContent = "not connected";
    say(`The viewer has ended; pp-cl view ${facts ? facts.name : "RUN"} shows the run again, at a new address.`, true);
    setTimeout(connect, RECONNECT);
  };
}

function take(message) {
  if (message.type === "facts") takeFacts(message);
  else if (message.type === "surroundings") takeSurroundings(message);
  else if (message.type === "log") { rows = message.rows; showCurve(); }
  else if (message.type === "refused") note(message.line, true);
}

function takeFacts(message) {
  const first = !facts || facts.step === undefined;
  facts = message;
  document.title = `${facts.name} - pp-cl view`;
  $("name").textContent = facts.name;
  if (facts.waiting) { $("status").textContent = "waiting"; say(facts.waiting); return; }
  say("");
  if (facts.notice) note(facts.notice, true);
  const state = facts.finished ? "finished" : "in training";
  $("status").textContent = `step ${facts.step} of ${facts.iterations}, ${facts.points} points, ${state}`;
  if (first) resetSliders();
}

function takeSurroundings(message) {
  around = message;
  if (!camera) jump(around.camera);
  if (facts.loads !== loads) { loads = facts.loads; ask(false); }
  drawOverlay();
}

// Ask for a picture; at most one request an animation frame.
function ask(draft) {
  if (draft) {
    moving = true;
    clearTimeout(stillTimer);
    stillTimer = setTimeout(() => { moving = false; ask(false); }, STILL);
  }
  if (asked || !camera) return;
  asked = true;
  requestAnimationFrame(() => { asked = false; send("frame", moving); });
}

function send(kind, draft) {
  if (!socket || socket.readyState !== WebSocket.OPEN || !camera) return;
  const values = Object.fromEntries(SLIDERS.map((id) => [id, value(id)]));
  socket.send(JSON.stringify({ number: ++number, kind, show: show(), draft, camera: sized(), ...values }));
}

async function takeFrame(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const frame = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const blob = new Blob([new Uint8Array(buffer, 4 + length)], { type: frame.mime });
  if (frame.type === "snapshot") { save(blob, `${facts.name}_step_${frame.step}_${frame.show}.png`); return; }
  const bitmap = await createImageBitmap(blob);
  if (frame.number <= shownNumber) return; // a newer one was decoded sooner
  shownNumber = frame.number;
  const picture = $("picture");
  picture.width = bitmap.width;
  picture.height = bitmap.height;
  picture.getContext("2d").drawImage(bitmap, 0, 0);
  bitmap.close();
  shownCamera = fromFacts(frame.camera);
  shownView = frame.view;
  if (photograph && frame.show === "photograph") jumpTo(frame.view); // to compare from the same place
  showFrameFacts(frame);
  layOut();
}

function showFrameFacts(frame) {
  const name = frame.view === null ? "" : around.views[frame.view].name;
  $("caption").textContent = { error: `|rendering - photograph| times 4, ${name}`, photograph: name }[frame.show] || "";
  $("scale").hidden = !frame.scale;
  if (frame.scale) {
    const unit = frame.show === "hits" ? " hits" : "";
    $("lowest").textContent = short(frame.scale[0]);
    $("highest").textContent = short(frame.scale[1]) + unit;
  }
  const rate = frame.per_second ?? 1000 / frame.milliseconds;
  const numbers = {
    device: facts.device, platform: facts.platform,
    "frames per second": rate.toFixed(1), rendering: `${frame.milliseconds} ms`,
    picture: `${frame.camera.w} x ${frame.camera.h}`, step: frame.step, points: facts.points,
  };
  $("numbers").replaceChildren(...Object.entries(numbers).flatMap(([key, text]) => {
    const [dt, dd] = [document.createElement("dt"), document.createElement("dd")];
    dt.textContent = key;
    dd.textContent = text;
    return [dt, dd];
  }));
  const data = document.body.dataset; // for tests and for the curious
  data.frames = Number(data.frames || 0) + 1;
  Object.assign(data, { number: frame.number, show: frame.show, draft: frame.draft, rate, step: frame.step });
}

// The camera at the size that is chosen, as far as the server allows it.
function sized() {
  const { w, h } = camera, most = Math.min(MOST_SIDE / Math.max(w, h), 0.999 * Math.sqrt(MOST_PIXELS / (w * h)));
  return toFacts(scaled(camera, Math.min(Number($("size").value), most)));
}

const short = (x) => Number(x.toPrecision(3)).toString();

// ---- what is shown

const show = () => (photograph ? "photograph" : document.querySelector("input[name=show]:checked").value);

function value(id) {
  const position = Number($(id).value);
  if (!CUBIC.includes(id)) return position;
  const trained = facts && Math.abs(position - Math.cbrt(2 * facts[id])) < 1e-9; // to the bit
  return trained ? facts[id] : 0.5 * position ** 3;
}

function resetSliders() {
  for (const id of CUBIC) $(id).value = Math.cbrt(2 * facts[id]);
  $("kept").value = 1;
  $("exposure").value = 0;
  showValues();
}

function showValues() {
  const texts = {
    early_stop: short(value("early_stop")),
    kept: `${Math.round(100 * value("kept"))} %`, exposure: `${value("exposure").toFixed(1)} stops`,
  };
  for (const id of SLIDERS) document.querySelector(`output[for=${id}]`).textContent = texts[id];
}

function showCurve() {
  $("training").hidden = !rows.length;
  if (!rows.length) return;
  const [, loss, psnr] = rows[rows.length - 1];
  $("last_psnr").textContent = psnr.toFixed(2);
  $("last_loss").textContent = loss.toPrecision(3);
  drawCurve($("curve"), rows);
}

function say(line, wrong = false) {
  clearTimeout(noteTimer);
  $("message").textContent = line;
  $("message").classList.toggle("wrong", wrong);
}

// A line that goes by itself.
function note(line, wrong = false) {
  say(line, wrong);
  noteTimer = setTimeout(() => say(""), NOTE);
}

// The picture as large as the stage allows.
function layOut() {
  const at = shownCamera || camera, stage = $("stage");
  if (at) {
    const scale = Math.min(stage.clientWidth / at.w, stage.clientHeight / at.h);
    const width = at.w * scale, height = at.h * scale;
    Object.assign($("frame").style, {
      width: `${width}px`, height: `${height}px`,
      left: `${(stage.clientWidth - width) / 2}px`, top: `${(stage.clientHeight - height) / 2}px`,
    });
  }
  drawOverlay();
}

// ---- the training views

// The frustums on an overlay of this width, none where they are switched off.
function shownFrustums(width) {
  if (!shownCamera || !around || $("frustums").ariaPressed !== "true" || OWN_CAMERA.includes(show())) return [];
  return frustums(around, shownCamera, width / shownCamera.w);
}

function drawOverlay(hovered = null) {
  const overlay = $("overlay"), ratio = window.devicePixelRatio || 1;
  overlay.width = overlay.clientWidth * ratio;
  overlay.height = overlay.clientHeight * ratio;
  const g = overlay.getContext("2d");
  g.scale(ratio, ratio);
  drawFrustums(g, shownFrustums(overlay.clientWidth), hovered);
}

// The view whose frustum is nearest to a pointer event, or null.
function viewAt(event) {
  const box = $("overlay").getBoundingClientRect();
  return frustumAt(shownFrustums(box.width), event.clientX - box.left, event.clientY - box.top);
}

function jump(facts) {
  camera = fromFacts(facts);
  pivot = around.centre;
}

function jumpTo(index) {
  jump(around.views[index].camera);
}

// ---- pointer and keys

const pointers = new Map();
let travelled = 0, before = null;

function move(change) {
  if (!camera) return;
  photograph = false;
  mark();
  change();
  ask(true);
}

function turn(dx, dy) {
  move(() => { camera = orbit(camera, pivot, around.up, -dx * RADIANS_PER_PIXEL, dy * RADIANS_PER_PIXEL); });
}

function slide(dx, dy) {
  const perPixel = camera.w / Math.max(1, $("frame").clientWidth);
  move(() => { [camera, pivot] = pan(camera, pivot, dx * perPixel, dy * perPixel); });
}

function nearer(factor) {
  move(() => { camera = zoom(camera, pivot, factor, around.radius); });
}

function gripOf() {
  const all = [...pointers.values()], n = all.length;
  const x = all.reduce((sum, p) => sum + p.clientX, 0) / n, y = all.reduce((sum, p) => sum + p.clientY, 0) / n;
  return { n, x, y, spread: n > 1 ? Math.hypot(all[0].clientX - all[1].clientX, all[0].clientY - all[1].clientY) : 0 };
}

function onDown(event) {
  $("stage").setPointerCapture(event.pointerId);
  if (!pointers.size) travelled = 0;
  pointers.set(event.pointerId, event);
  before = gripOf();
  $("stage").classList.add("turning");
}

function onMove(event) {
  if (!pointers.has(event.pointerId)) {
    const index = viewAt(event);
    $("stage").classList.toggle("over", index !== null);
    if (!OWN_CAMERA.includes(show())) $("caption").textContent = index === null ? "" : around.views[index].name;
    drawOverlay(index);
    return;
  }
  pointers.set(event.pointerId, event);
  const grip = gripOf(), dx = grip.x - before.x, dy = grip.y - before.y;
  travelled += Math.abs(dx) + Math.abs(dy) + Math.abs(grip.spread - before.spread);
  if (travelled > CLICK && grip.n === before.n && camera) {
    if (grip.n > 1) {
      slide(dx, dy);
      nearer(before.spread / Math.max(1, grip.spread));
    } else if (event.buttons & 6 || event.shiftKey) slide(dx, dy);
    else turn(dx, dy);
  }
  before = grip;
}

function onUp(event) {
  const index = pointers.size === 1 && travelled <= CLICK && event.type === "pointerup" ? viewAt(event) : null;
  pointers.delete(event.pointerId);
  before = pointers.size ? gripOf() : null;
  $("stage").classList.toggle("turning", pointers.size > 0);
  if (index !== null) { jumpTo(index); ask(false); }
}

function flip() {
  if (!around) return;
  if (!facts.photographs) { note(facts.notice, true); return; }
  photograph = !photograph;
  mark();
  ask(false);
}

function mark() {
  $("flip").ariaPressed = photograph;
}

function toggle(id) {
  $(id).ariaPressed = $(id).ariaPressed !== "true";
  $("numbers").hidden = $("device").ariaPressed !== "true";
  drawOverlay();
}

function reset() {
  if (!around) return;
  photograph = false;
  mark();
  jump(around.camera);
  resetSliders();
  ask(false);
}

async function copyCamera() {
  if (!camera) return;
  const box = $("camera"), own = photograph || show() === "error";
  const at = own && shownView !== null ? around.views[shownView].camera : sized();
  box.value = JSON.stringify(at, null, 1);
  box.hidden = false;
  try {
    await navigator.clipboard.writeText(box.value);
    note("The camera is in the clipboard.");
  } catch { // only 127.0.0.1 and https may write to the clipboard
    box.focus();
    box.select();
    note("The camera is selected; copy it from there.");
  }
}

function save(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), RECONNECT);
}

const KEYS = {
  f: flip, r: reset, c: copyCamera, s: () => send("snapshot", false),
  v: () => toggle("frustums"), i: () => toggle("device"),
  ArrowLeft: () => turn(-20, 0), ArrowRight: () => turn(20, 0), ArrowUp: () => turn(0, -20), ArrowDown: () => turn(0, 20),
  "+": () => nearer(0.9), "=": () => nearer(0.9), "-": () => nearer(1.1),
};

function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("select, textarea, input")) return;
  const shows = document.querySelectorAll("input[name=show]");
  if (shows[event.key - 1]) shows[event.key - 1].click();
  else if (KEYS[event.key] && camera) KEYS[event.key]();
  else return;
  event.preventDefault();
}

const stage = $("stage");
stage.addEventListener("pointerdown", onDown);
stage.addEventListener("pointermove", onMove);
stage.addEventListener("pointerup", onUp);
stage.addEventListener("pointercancel", onUp);
stage.addEventListener("contextmenu", (event) => event.preventDefault());
stage.addEventListener("wheel", (event) => {
  event.preventDefault();
  const lines = event.deltaMode ? 30 : 1;
  nearer(Math.exp(Math.max(-400, Math.min(400, event.deltaY * lines)) * ZOOM_PER_PIXEL));
}, { passive: false });
window.addEventListener("keydown", onKey);
window.addEventListener("resize", () => { layOut(); showCurve(); });
for (const id of SLIDERS) $(id).addEventListener("input", () => { showValues(); ask(true); });
$("size").addEventListener("change", () => ask(false));
for (const input of document.querySelectorAll("input[name=show]")) {
  input.addEventListener("change", () => { photograph = false; mark(); ask(false); });
}
$("flip").addEventListener("click", flip);
$("reset").addEventListener("click", reset);
$("copy").addEventListener("click", copyCamera);
$("snapshot").addEventListener("click", () => send("snapshot", false));
$("frustums").addEventListener("click", () => toggle("frustums"));
$("device").addEventListener("click", () => toggle("device"));
showValues();
connect();
