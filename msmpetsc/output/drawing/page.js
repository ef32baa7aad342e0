"use strict";
// The page of a result: unpacks its frames, draws them with WebGL, and listens to mouse, fingers, keys and address.

const data = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const canvas = byId("view"), slider = byId("slider"), play = byId("play"), speedChoice = byId("speed");
const frames = data.times ? data.times.length : 0, points = data.points;
const box = data.box || [[0, 0, 0], [1, 1, 1]], size = box[1].map((high, k) => Math.max(high - box[0][k], 1e-30));
const reach = Math.max(...size), middle = box[0].map((low, k) => low + size[k] / 2);
const view = { frame: 0, yaw: 0, pitch: 0, zoom: 1, right: 0, up: 0, playing: false };
const dark = matchMedia("(prefers-color-scheme: dark)");

// Vectors

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const sum = (a, b, factor = 1) => a.map((x, k) => x + factor * b[k]);
const scaled = (a, factor) => a.map((x) => x * factor);
const unit = (a) => scaled(a, 1 / (Math.hypot(...a) || 1));
const colour = (text) => [1, 3, 5].map((k) => parseInt(text.slice(k, k + 2), 16) / 255);

// Unpacking

async function inflated(name) {
  const text = atob(data.streams[name]), bytes = new Uint8Array(text.length);
  for (let k = 0; k < text.length; k++) bytes[k] = text.charCodeAt(k);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

function predicted(bytes) { // the frames' positions, from what is left of their prediction
  const n = 3 * points, all = new Uint16Array(frames * n);
  for (let f = 0; f < frames; f++) {
    const low = 2 * n * f, high = low + n, at = n * f, p = at - n, q = p - n;
    for (let k = 0; k < n; k++) {
      const coded = bytes[low + k] | (bytes[high + k] << 8);
      const left = coded & 1 ? -((coded + 1) >> 1) : coded >> 1;
      all[at + k] = (f === 0 ? 0 : f === 1 ? all[p + k] : 2 * all[p + k] - all[q + k]) + left;
    }
  }
  return all;
}

function summed(bytes) {
  for (let k = points; k < bytes.length; k++) bytes[k] += bytes[k - points];
  return bytes;
}

// Drawing

const LIT = [`#version 300 es
in vec3 position; in vec3 normal; in float number; in float fixing;
uniform mat4 camera; uniform mat3 turning; uniform vec3 low; uniform vec3 size; uniform sampler2D scale;
uniform vec3 fixedColour;
out vec3 facing; out vec3 paint;
void main() {
  facing = turning * normal;
  paint = mix(texture(scale, vec2((number + 0.5) / 256.0, 0.5)).rgb, fixedColour, fixing);
  gl_Position = camera * vec4(low + size * position, 1.0);
}`, `#version 300 es
precision mediump float;
in vec3 facing; in vec3 paint; out vec4 pixel;
void main() {
  vec3 n = normalize(facing);
  if (!gl_FrontFacing) n = -n;
  float light = 0.42 + 0.62 * (0.85 * max(0.0, dot(n, normalize(vec3(-0.5, 1.1, 1.3))))
    + 0.35 * max(0.0, dot(n, normalize(vec3(1.0, 0.15, 0.65)))));
  pixel = vec4(paint * light, 1.0);
}`];
const FLAT = [`#version 300 es
in vec3 position; uniform mat4 camera; uniform vec3 low; uniform vec3 size; uniform vec4 plane; uniform float lift;
void main() {
  vec3 at = low + size * position;
  at -= plane.xyz * (dot(plane.xyz, at) - plane.w - lift);
  gl_Position = camera * vec4(at, 1.0);
}`, `#version 300 es
precision mediump float;
uniform vec4 paint; out vec4 pixel;
void main() { pixel = vec4(paint.rgb * paint.a, paint.a); }`];

let gl, lit, flat, all, numbers, fixing, triangles, buffers = {}, counted = -1;

function program(sources) {
  const made = gl.createProgram();
  [gl.VERTEX_SHADER, gl.FRAGMENT_SHADER].forEach((kind, k) => {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, sources[k]);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  });
  gl.linkProgram(made);
  const attributes = {}, uniforms = {};
  for (const name of ["position", "normal", "number", "fixing"]) attributes[name] = gl.getAttribLocation(made, name);
  for (const name of ["camera", "turning", "low", "size", "scale", "fixedColour", "plane", "lift", "paint"])
    uniforms[name] = gl.getUniformLocation(made, name);
  return { made, attributes, uniforms };
}

function filled(name, values, target = gl.ARRAY_BUFFER) {
  buffers[name] ??= gl.createBuffer();
  gl.bindBuffer(target, buffers[name]);
  gl.bufferData(target, values, gl.DYNAMIC_DRAW);
}

function attribute(used, name, buffer, count, kind, normalised) {
  const at = used.attributes[name];
  if (at < 0) return;
  gl.bindBuffer(gl.ARRAY_BUFFER, buffers[buffer]);
  gl.enableVertexAttribArray(at);
  gl.vertexAttribPointer(at, count, kind, normalised, 0, 0);
}

function start() {
  gl = canvas.getContext("webgl2", { antialias: true, alpha: true });
  if (!gl) throw new Error("this browser has no WebGL 2, which draws the body");
  lit = program(LIT);
  flat = program(FLAT);
  gl.enable(gl.DEPTH_TEST);
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  const texels = new Uint8Array(data.scale.flatMap((rgb) => [...rgb, 255]));
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, texels);
  for (const what of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, what, gl.NEAREST);
  filled("triangles", triangles, gl.ELEMENT_ARRAY_BUFFER);
  filled("numbers", new Uint8Array(points));
}

function normals(at) { // of the points, from the triangles around each, weighed by their areas
  const sums = new Float32Array(3 * points), [sx, sy, sz] = size;
  for (let k = 0; k < triangles.length; k += 3) {
    const a = 3 * triangles[k], b = 3 * triangles[k + 1], c = 3 * triangles[k + 2];
    const ux = sx * (at[b] - at[a]), uy = sy * (at[b + 1] - at[a + 1]), uz = sz * (at[b + 2] - at[a + 2]);
    const vx = sx * (at[c] - at[a]), vy = sy * (at[c + 1] - at[a + 1]), vz = sz * (at[c + 2] - at[a + 2]);
    const nx = uy * vz - uz * vy, ny = uz * vx - ux * vz, nz = ux * vy - uy * vx;
    for (const corner of [a, b, c]) { sums[corner] += nx; sums[corner + 1] += ny; sums[corner + 2] += nz; }
  }
  let most = 0;
  for (const x of sums) most = Math.max(most, Math.abs(x));
  for (let k = 0; k < sums.length; k++) sums[k] /= most || 1; // or squares of small ones would be none
  return sums;
}

function loadFrame() {
  if (counted === view.frame) return;
  counted = view.frame;
  const at = all.subarray(3 * points * counted, 3 * points * (counted + 1));
  filled("positions", at);
  filled("normals", normals(at));
  filled("fixing", fixing.subarray(points * data.fixed[counted], points * (data.fixed[counted] + 1)));
  if (numbers) filled("numbers", numbers.subarray(points * counted, points * (counted + 1)));
}

function axesOfEye() {
  const { right, away, up, elevation } = data.camera;
  const yaw = view.yaw * Math.PI / 180, pitch = elevation + view.pitch * Math.PI / 180;
  const across = sum(scaled(right, Math.cos(yaw)), away, Math.sin(yaw));
  const ahead = sum(scaled(away, Math.cos(yaw)), right, -Math.sin(yaw));
  const toEye = sum(scaled(up, Math.sin(pitch)), ahead, -Math.cos(pitch));
  return { across, upward: sum(scaled(up, Math.cos(pitch)), ahead, Math.sin(pitch)), toEye };
}

function perMetre() { // pixels of the page, so that the box around all frames fits however it is turned
  const { clientWidth: w, clientHeight: h } = canvas, { across, upward } = axesOfEye0;
  const extent = (axis) => size.reduce((all, side, k) => all + side * Math.abs(axis[k]), 0);
  return view.zoom * Math.min(w / (1.3 * extent(across)), h / (1.25 * extent(upward)));
}

function cameraMatrix(eye) {
  const scale = perMetre(), x = 2 * scale / canvas.clientWidth, y = 2 * scale / canvas.clientHeight;
  const depth = 1 / (8 * reach), rows = [scaled(eye.across, x), scaled(eye.upward, y), scaled(eye.toEye, -depth)];
  const shift = rows.map((row, k) => -dot(row, middle) + [x * view.right, y * view.up, 0][k]);
  return { matrix: new Float32Array([0, 1, 2].flatMap((k) => [rows[0][k], rows[1][k], rows[2][k], 0]).concat(shift, 1)), rows, shift };
}

function use(used, camera, low, extent) {
  gl.useProgram(used.made);
  for (let k = 0; k < 4; k++) gl.disableVertexAttribArray(k);
  gl.uniformMatrix4fv(used.uniforms.camera, false, camera);
  gl.uniform3fv(used.uniforms.low, low);
  gl.uniform3fv(used.uniforms.size, extent);
  if (used === flat) { gl.uniform4f(flat.uniforms.plane, 0, 0, 0, 0); gl.uniform1f(flat.uniforms.lift, 0); }
}

function drawFlat(camera, corners, mode, paint, indices) {
  use(flat, camera, [0, 0, 0], [1, 1, 1]);
  filled("corners", new Float32Array(corners.flat()));
  attribute(flat, "position", "corners", 3, gl.FLOAT, false);
  gl.uniform4fv(flat.uniforms.paint, paint);
  if (!indices) return gl.drawArrays(mode, 0, corners.length);
  filled("indices", new Uint16Array(indices), gl.ELEMENT_ARRAY_BUFFER);
  gl.drawElements(mode, indices.length, gl.UNSIGNED_SHORT, 0);
}

function bodyElements() {
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffers.triangles);
  gl.drawElements(gl.TRIANGLES, triangles.length, triangles.BYTES_PER_ELEMENT === 2 ? gl.UNSIGNED_SHORT : gl.UNSIGNED_INT, 0);
}

function drawGround(camera, ground, eye) {
  const night = dark.matches;
  drawFlat(camera, ground.corners, gl.LINE_LOOP, [...colour(night ? "#59616b" : "#b9b3a6"), 1]);
  if (dot(ground.normal, eye.toEye) <= 0) return; // seen from below, it would hide the body
  drawFlat(camera, ground.corners, gl.TRIANGLE_FAN, [...colour(night ? "#2b3037" : "#efece6"), 1]);
  use(flat, camera, box[0], size);
  gl.uniform4f(flat.uniforms.plane, ...ground.normal, dot(ground.normal, ground.corners[0]));
  gl.uniform1f(flat.uniforms.lift, 2e-3 * reach);
  gl.uniform4fv(flat.uniforms.paint, [...colour(night ? "#17191d" : "#cdc7bb"), 1]);
  attribute(flat, "position", "positions", 3, gl.UNSIGNED_SHORT, true);
  bodyElements();
}

function drawBody(camera, { across, upward, toEye }) {
  use(lit, camera, box[0], size);
  const turning = [0, 1, 2].flatMap((k) => [across[k], upward[k], toEye[k]]);
  gl.uniformMatrix3fv(lit.uniforms.turning, false, turning);
  attribute(lit, "position", "positions", 3, gl.UNSIGNED_SHORT, true);
  attribute(lit, "normal", "normals", 3, gl.FLOAT, false);
  attribute(lit, "number", "numbers", 1, gl.UNSIGNED_BYTE, false);
  attribute(lit, "fixing", "fixing", 1, gl.UNSIGNED_BYTE, true);
  gl.uniform3fv(lit.uniforms.fixedColour, colour("#46566b"));
  bodyElements();
}

const FACES = [0, 1, 3, 0, 3, 2, 4, 5, 7, 4, 7, 6, 0, 1, 5, 0, 5, 4, 2, 3, 7, 2, 7, 6, 0, 2, 6, 0, 6, 4, 1, 3, 7, 1, 7, 5];
const EDGES = [0, 1, 2, 3, 4, 5, 6, 7, 0, 2, 1, 3, 4, 6, 5, 7, 0, 4, 1, 5, 2, 6, 3, 7];

function drawGlass(camera, corners) {
  gl.enable(gl.BLEND);
  gl.depthMask(false);
  drawFlat(camera, corners, gl.TRIANGLES, [...colour("#a3b6c4"), 0.16], FACES);
  gl.depthMask(true);
  gl.disable(gl.BLEND);
  drawFlat(camera, corners, gl.LINES, [...colour("#667e90"), 1], EDGES);
}

function drawArrow(camera, [tail, tip], eye) { // flat, as wide seen from every side
  const along = sum(tip, tail, -1), aside = scaled(unit(cross(along, eye.toEye)), Math.hypot(...along));
  const at = (far, wide) => sum(sum(tail, along, far), aside, wide);
  const shaft = [at(0, 0.045), at(0, -0.045), at(0.66, -0.045), at(0.66, 0.045)];
  drawFlat(camera, shaft, gl.TRIANGLE_FAN, [...colour("#cf5a3c"), 1]);
  drawFlat(camera, [at(0.64, 0.13), at(0.64, -0.13), tip], gl.TRIANGLES, [...colour("#cf5a3c"), 1]);
}

const CORNERS = [0, 1, 2, 3, 4, 5, 6, 7].map((n) => [n >> 2 & 1, n >> 1 & 1, n & 1].map((bit, k) => box[bit][k]));

function drawAxes(camera, rows, shift) {
  byId("labels").replaceChildren();
  if (!data.axes) return;
  drawFlat(camera, CORNERS, gl.LINES, [...colour(dark.matches ? "#98a1ab" : "#6b737d"), 1], EDGES);
  const seen = (point) => [0, 1].map((k) => (dot(rows[k], point) + shift[k]) * [canvas.clientWidth, canvas.clientHeight][k] / 2);
  const centre = seen(middle);
  [2, 1, 0].forEach((axis, number) => { // four edges along each: the label is at the outermost
    const ends = [0, 1, 2, 3].map((k) => EDGES.slice(8 * number + 2 * k, 8 * number + 2 * k + 2));
    const ways = ends.map(([a, b]) => sum(seen(scaled(sum(CORNERS[a], CORNERS[b]), 0.5)), centre, -1));
    const way = ways.reduce((a, b) => Math.hypot(...b) > Math.hypot(...a) + 1e-6 ? b : a);
    const [low, high] = box.map((end) => Math.abs(end[axis]) < 1e-6 * reach ? 0 : +end[axis].toPrecision(3));
    const label = document.createElement("span"), [x, y] = sum(sum(centre, way), unit(way), 14);
    label.textContent = `${"xyz"[axis]}: ${low} to ${high} m`;
    label.style.left = `${canvas.clientWidth / 2 + x}px`;
    label.style.top = `${canvas.clientHeight / 2 - y}px`;
    label.style.transform = `translate(${Math.abs(unit(way)[0]) < 0.3 ? -50 : way[0] > 0 ? 0 : -100}%, -50%)`;
    byId("labels").append(label);
  });
}

function draw() {
  const density = Math.min(window.devicePixelRatio || 1, 2);
  canvas.width = Math.max(1, Math.round(canvas.clientWidth * density));
  canvas.height = Math.max(1, Math.round(canvas.clientHeight * density));
  gl.viewport(0, 0, canvas.width, canvas.height);
  gl.clearColor(0, 0, 0, 0);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  loadFrame();
  const eye = axesOfEye(), { matrix, rows, shift } = cameraMatrix(eye);
  const state = data.overlays.states[data.overlays.numbers[view.frame]];
  for (const ground of state.grounds) drawGround(matrix, ground, eye);
  drawBody(matrix, eye);
  drawAxes(matrix, rows, shift);
  for (const corners of state.glass) drawGlass(matrix, corners);
  gl.clear(gl.DEPTH_BUFFER_BIT); // arrows are in front of all
  for (const arrow of state.arrows) drawArrow(matrix, arrow, eye);
  showState();
}

let asked = false;
function redraw() {
  if (!asked) requestAnimationFrame(() => { asked = false; draw(); });
  asked = true;
}

// What stands around the picture

function showState() {
  const rate = +speedChoice.value;
  const pace = frames > 1 && rate !== 1 ? (rate < 1 ? `   ${+(1 / rate).toPrecision(3)} times slower` : `   ${rate} times faster`) : "";
  byId("time").textContent = `t = ${data.times[view.frame].toFixed(3)} s${pace}`;
  slider.value = view.frame;
  play.textContent = view.playing ? "❚❚" : "▶";
  play.setAttribute("aria-label", view.playing ? "Pause" : "Play");
  const most = 160 / perMetre(), power = 10 ** Math.floor(Math.log10(most));
  const length = power * [5, 2, 1].find((step) => step * power <= most), bar = byId("length");
  const [scale, name] = length >= 1 ? [1, "m"] : length >= 0.01 ? [0.01, "cm"] : length >= 1e-3 ? [1e-3, "mm"] : [1e-6, "µm"];
  bar.firstChild.style.width = `${length * perMetre()}px`;
  bar.lastChild.textContent = `${+(length / scale).toPrecision(3)} ${name}`;
}

function legendEntry({ kind, text, colour: paint, low, high }) {
  const entry = document.createElement("span"), mark = document.createElement(kind === "arrow" ? "b" : "i");
  mark.className = kind;
  if (kind === "arrow") { mark.textContent = "➞"; mark.style.color = paint; }
  else if (kind === "bar") mark.style.background = `linear-gradient(to right, ${data.scale.filter((_, k) => k % 15 === 0).map((rgb) => `rgb(${rgb})`)})`;
  else mark.style.background = paint;
  const words = [high, text].filter((part) => part).join("\u2002");
  entry.append(low, mark, words);
  return entry;
}

function makeLegend() {
  byId("legend").append(...data.legend.map(legendEntry));
  const bar = document.createElement("span"), mark = document.createElement("i");
  bar.id = "length";
  mark.className = "length";
  bar.append(mark, document.createElement("span"));
  byId("legend").append(bar);
}

function makePlayer() {
  slider.max = frames - 1;
  byId("player").hidden = frames < 2;
  const spacing = (data.times[frames - 1] - data.times[0]) / 4; // a play of about four seconds
  const rates = [4, 2, 1, 0.5, 0.25, 0.1, 0.05, 0.02, 0.01, 0.005, 0.001];
  const nearest = spacing >= 0.5 ? 1 : rates.reduce((a, b) => Math.abs(Math.log(b / spacing)) < Math.abs(Math.log(a / spacing)) ? b : a);
  for (const rate of rates) {
    const option = new Option(rate === 1 ? "real time" : rate > 1 ? `${rate} × faster` : `${Math.round(1 / rate)} × slower`, rate);
    option.selected = rate === nearest;
    speedChoice.append(option);
  }
}

// Time

let begun = null; // when the play began [ms], and at which time of the result [s]
function tick(now) {
  if (!view.playing) return;
  begun ??= { now, time: view.frame === frames - 1 ? data.times[0] : data.times[view.frame] };
  const time = begun.time + +speedChoice.value * (now - begun.now) / 1000;
  let frame = view.frame === frames - 1 && time < data.times[frames - 1] ? 0 : view.frame;
  while (frame < frames - 1 && data.times[frame + 1] <= time) frame++;
  if (frame !== view.frame) { view.frame = frame; draw(); }
  if (time > data.times[frames - 1] + 0.3 * +speedChoice.value) { begun = { now, time: data.times[0] }; view.frame = 0; draw(); }
  requestAnimationFrame(tick);
}

function setPlaying(playing) {
  view.playing = playing && frames > 1;
  begun = null;
  if (view.playing) requestAnimationFrame(tick);
  noteAddress();
  redraw();
}

function goTo(frame) {
  view.frame = Math.min(frames - 1, Math.max(0, Math.round(frame) || 0));
  begun = null;
  noteAddress();
  redraw();
}

// The address: #frame=40&turn=30,10&zoom=2&move=0.1,0 is a view, and a link to it

function readAddress() {
  const given = new URLSearchParams(location.hash.slice(1));
  const pair = (name) => (given.get(name) || "").split(",").map((part) => +part || 0);
  [view.yaw, view.pitch = 0] = pair("turn");
  [view.right, view.up = 0] = pair("move");
  view.zoom = Math.min(50, Math.max(0.2, +given.get("zoom") || 1));
  const frame = given.has("frame") ? +given.get("frame") : 0;
  view.frame = Math.min(frames - 1, Math.max(0, Math.round(frame) || 0));
  view.playing = given.get("play") === "1" && frames > 1;
  begun = null;
}

function noteAddress() {
  const round = (x) => +x.toPrecision(4);
  const parts = [`frame=${view.frame}`, `turn=${round(view.yaw)},${round(view.pitch)}`];
  if (view.zoom !== 1) parts.push(`zoom=${round(view.zoom)}`);
  if (view.right || view.up) parts.push(`move=${round(view.right)},${round(view.up)}`);
  if (view.playing) parts.push("play=1");
  try { history.replaceState(null, "", `#${parts.join("&")}`); } catch { /* a browser may forbid it to files */ }
}

// Mouse, fingers, keys

const fingers = new Map();
const apart = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a.x - b.x, a.y - b.y) || 1; };

function turn(dx, dy) {
  view.yaw = (view.yaw - 0.4 * dx) % 360;
  const steepest = 90 - 180 * data.camera.elevation / Math.PI;
  view.pitch = Math.min(steepest, Math.max(steepest - 180, view.pitch + 0.4 * dy));
}

function shift(dx, dy) {
  view.right += dx / perMetre();
  view.up -= dy / perMetre();
}

function nearer(factor) {
  view.zoom = Math.min(50, Math.max(0.2, view.zoom * factor));
}

function changed() { noteAddress(); redraw(); }

canvas.addEventListener("pointerdown", (event) => {
  canvas.setPointerCapture(event.pointerId);
  fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
});
canvas.addEventListener("pointermove", (event) => {
  const finger = fingers.get(event.pointerId);
  if (!finger) return;
  const before = fingers.size === 2 ? apart() : 0, dx = event.clientX - finger.x, dy = event.clientY - finger.y;
  Object.assign(finger, { x: event.clientX, y: event.clientY });
  if (fingers.size === 2) { nearer(apart() / before); shift(dx / 2, dy / 2); }
  else if (event.shiftKey || event.buttons === 2) shift(dx, dy);
  else turn(dx, dy);
  changed();
});
for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
canvas.addEventListener("contextmenu", (event) => event.preventDefault());
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  nearer(Math.exp(-0.001 * event.deltaY * (event.deltaMode ? 30 : 1)));
  changed();
}, { passive: false });
slider.addEventListener("input", () => { view.playing = false; goTo(+slider.value); });
play.addEventListener("click", () => setPlaying(!view.playing));
speedChoice.addEventListener("change", () => { begun = null; redraw(); });
const KEYS = {
  " ": () => setPlaying(!view.playing),
  ArrowRight: () => { view.playing = false; goTo(view.frame + 1); },
  ArrowLeft: () => { view.playing = false; goTo(view.frame - 1); },
  Home: () => goTo(0),
  End: () => goTo(frames - 1),
  "+": () => { nearer(1.2); changed(); },
  "-": () => { nearer(1 / 1.2); changed(); },
  ArrowUp: () => { turn(0, 12); changed(); },
  ArrowDown: () => { turn(0, -12); changed(); },
  r: () => { Object.assign(view, { yaw: 0, pitch: 0, zoom: 1, right: 0, up: 0 }); changed(); },
};
addEventListener("keydown", (event) => {
  const act = KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (!act || event.ctrlKey || event.metaKey || event.altKey || event.target === speedChoice) return;
  event.preventDefault();
  act();
});
addEventListener("resize", redraw);
addEventListener("hashchange", () => { readAddress(); if (view.playing) setPlaying(true); redraw(); });
dark.addEventListener("change", redraw);

// A run that goes on: its numbers, its energies over time, and the page loaded again

const CURVES = ["#d08a1d", "#1d91c0", "#5aa469", "#b56aa8"];

function curvesOf({ names, curves }) {
  const svg = (name, attributes) => {
    const made = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    return made;
  };
  const chart = svg("svg", { viewBox: "0 0 300 110", role: "img", "aria-label": "energies over time" });
  const energies = curves.flatMap((row) => row.slice(1)).concat(0), first = curves[0][0];
  const low = Math.min(...energies), high = Math.max(...energies), span = curves.at(-1)[0] - first;
  names.slice(1).forEach((name, k) => {
    const corners = curves.map((row) => `${300 * (row[0] - first) / (span || 1)},${92 - 88 * (row[k + 1] - low) / (high - low || 1)}`);
    chart.append(svg("polyline", { points: corners.join(" "), fill: "none", stroke: CURVES[k], "stroke-width": 1.5 }));
    const text = svg("text", { x: 75 * k, y: 108, style: `fill: ${CURVES[k]}` });
    text.textContent = name;
    chart.append(text);
  });
  return chart;
}

function showRun(run) {
  const list = document.createElement("dl");
  for (const [name, value] of Object.entries(run.rows)) {
    const term = document.createElement("dt"), number = document.createElement("dd");
    term.textContent = name;
    number.textContent = value;
    list.append(term, number);
  }
  byId("run").append(list);
  if (run.curves.length > 1) byId("run").append(curvesOf(run));
  byId("run").hidden = false;
  if (run.refresh) setTimeout(reload, 1000 * run.refresh);
}

function reload() { // but not while the body is being turned
  if (fingers.size) setTimeout(reload, 500);
  else location.reload();
}

// Begin

let axesOfEye0;
async function begin() {
  if (data.run) showRun(data.run);
  if (!frames) {
    for (const id of ["player", "keys"]) byId(id).hidden = true;
    return;
  }
  const wide = points > 65535, packed = await inflated("triangles");
  triangles = new (wide ? Uint32Array : Uint16Array)(packed.buffer);
  fixing = await inflated("fixed");
  all = predicted(await inflated("positions"));
  numbers = data.streams.colours ? summed(await inflated("colours")) : null;
  axesOfEye0 = axesOfEye(); // the first view says how large the body is drawn, and turning does not change it
  start();
  makeLegend();
  makePlayer();
  readAddress();
  draw();
  if (view.playing) setPlaying(true);
  document.documentElement.dataset.ready = "1";
}
begin().catch((error) => {
  byId("message").hidden = false;
  byId("message").textContent = `This page cannot be shown: ${error.message}`;
});
