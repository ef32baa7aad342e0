// Drawing with WebGL: the body, its ground and shadow, glass and arrows.

const LIGHT = `
float light(vec3 n) {
  n.z = abs(n.z); // visible surfaces face the eye, but interpolated normals may not
  return 0.42 + 0.62 * (0.85 * max(0.0, dot(n, normalize(vec3(-0.5, 1.1, 1.3))))
    + 0.35 * max(0.0, dot(n, normalize(vec3(1.0, 0.15, 0.65)))));
}`;
const LIT = [`#version 300 es
in vec3 position; in vec3 normal; in float number; in float fixing;
uniform mat4 camera; uniform mat3 turning; uniform vec3 low; uniform vec3 size; uniform sampler2D scale;
out vec3 facing; out vec3 paint; out float held;
void main() {
  facing = turning * normal;
  paint = texture(scale, vec2((number + 0.5) / 256.0, 0.5)).rgb;
  held = fixing;
  gl_Position = camera * vec4(low + size * position, 1.0);
}`, `#version 300 es
precision mediump float;
in vec3 facing; in vec3 paint; in float held; uniform vec3 fixedColour; out vec4 pixel;
${LIGHT}
void main() {
  vec3 colour = held > 0.5 ? fixedColour : paint; // as renderer.py
  pixel = vec4(colour * light(normalize(facing)), 1.0);
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
}

// Return outward normals at the points, summed over the triangles around each and weighted by area.
// They are not unit vectors: the largest component of all is 1.
function normals(at) {
  const sums = new Float32Array(3 * points), [sx, sy, sz] = size;
  for (let k = 0; k < triangles.length; k += 3) {
    const a = 3 * triangles[k], b = 3 * triangles[k + 1], c = 3 * triangles[k + 2];
    const ux = sx * (at[b] - at[a]), uy = sy * (at[b + 1] - at[a + 1]), uz = sz * (at[b + 2] - at[a + 2]);
    const vx = sx * (at[c] - at[a]), vy = sy * (at[c + 1] - at[a + 1]), vz = sz * (at[c + 2] - at[a + 2]);
    const nx = uy * vz - uz * vy, ny = uz * vx - ux * vz, nz = ux * vy - uy * vx;
    for (const corner of [a, b, c]) { sums[corner] += nx; sums[corner + 1] += ny; sums[corner + 2] += nz; }
  }
  let most = 0, volume = 0;
  for (let k = 0; k < sums.length; k++) volume += size[k % 3] * (at[k] - 32767) * sums[k];
  for (const x of sums) most = Math.max(most, Math.abs(x));
  // outwards, and scaled so that squares do not overflow
  for (let k = 0; k < sums.length; k++) sums[k] /= (volume < 0 ? -most : most) || 1;
  return sums;
}

function loadFrame() {
  if (counted === view.frame) return;
  counted = view.frame;
  const at = all.subarray(3 * points * counted, 3 * points * (counted + 1));
  filled("positions", at);
  filled("normals", normals(at));
  filled("fixing", fixing.subarray(points * counted, points * (counted + 1)));
  filled("numbers", numbers.subarray(points * counted, points * (counted + 1)));
}

function axesOfEye() {
  const { right, away, up, elevation } = data.camera;
  const yaw = view.yaw * Math.PI / 180, pitch = elevation + view.pitch * Math.PI / 180;
  const across = sum(scaled(right, Math.cos(yaw)), away, Math.sin(yaw));
  const ahead = sum(scaled(away, Math.cos(yaw)), right, -Math.sin(yaw));
  const toEye = sum(scaled(up, Math.sin(pitch)), ahead, -Math.cos(pitch));
  return { across, upward: sum(scaled(up, Math.cos(pitch)), ahead, Math.sin(pitch)), toEye };
}

// Return twice the largest distances, across and upward, of all drawn points from the middle.
function firstExtent() {
  const beside = data.overlays.flatMap(({ grounds, glass, balls, meshes }) => [
    ...grounds.map((ground) => CORNERS.map((corner) => below(ground, corner))), ...glass, ...[...balls, ...meshes].map((round) => round.seen)]);
  const { across, upward } = axesOfEye(), every = [...CORNERS, ...beside.flat()];
  return [across, upward].map((axis) => 2 * Math.max(...every.map((point) => Math.abs(dot(axis, sum(point, middle, -1))))));
}

// Return the page's pixels per metre; turning the body does not change the scale.
function perMetre() {
  const [wide, high] = extent;
  return view.zoom * Math.min(canvas.clientWidth / (1.12 * wide), canvas.clientHeight / (1.12 * high));
}

function cameraMatrix(eye) {
  const scale = perMetre(), x = 2 * scale / canvas.clientWidth, y = 2 * scale / canvas.clientHeight;
  const depth = 1 / (8 * reach), rows = [scaled(eye.across, x), scaled(eye.upward, y), scaled(eye.toEye, -depth)];
  const shift = rows.map((row, k) => -dot(row, middle) + [x * view.right, y * view.up, 0][k]);
  return new Float32Array([0, 1, 2].flatMap((k) => [rows[0][k], rows[1][k], rows[2][k], 0]).concat(shift, 1));
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

const below = ({ corners, normal }, point) => sum(point, normal, dot(normal, sum(corners[0], point, -1)));

// number of rings of a ground; share of its radius from which it fades
const RINGS = 16, SOLID = 0.55;

// Draw a ground as a disk of rings within its corners, and the body's shadow.
function drawGround(camera, ground, eye) {
  const night = dark.matches, [a, b, , d] = ground.corners, seenFromAbove = dot(ground.normal, eye.toEye) > 0;
  const halves = [b, d].map((corner) => scaled(sum(corner, a, -1), 0.5)), centre = sum(sum(a, halves[0]), halves[1]);
  const ring = (r) => TURNS.map((turn) => sum(sum(centre, halves[0], r * Math.cos(turn)), halves[1], r * Math.sin(turn)));
  // from below, a disk would hide the body
  if (!seenFromAbove) {
    drawFlat(camera, ring(SOLID), gl.LINE_LOOP, [...colour(night ? "#59616b" : "#b9b3a6"), 1]);
    return;
  }
  const paint = colour(night ? "#2b3037" : "#efece6");
  gl.disable(gl.DEPTH_TEST); // the ground is drawn first, and all rings lie in one plane
  gl.enable(gl.BLEND);
  for (let k = 0; k < RINGS; k++) drawFlat(camera, ring(1 - (1 - SOLID) * k / RINGS), gl.TRIANGLE_FAN, [...paint, 3 / RINGS]);
  gl.disable(gl.BLEND);
  drawFlat(camera, ring(SOLID), gl.TRIANGLE_FAN, [...paint, 1]);
  gl.enable(gl.DEPTH_TEST);
  use(flat, camera, box[0], size);
  gl.uniform4f(flat.uniforms.plane, ...ground.normal, dot(ground.normal, ground.corners[0]));
  gl.uniform1f(flat.uniforms.lift, 2e-3 * reach);
  gl.uniform4fv(flat.uniforms.paint, [...colour(night ? "#17191d" : "#cdc7bb"), 1]);
  attribute(flat, "position", "positions", 3, gl.UNSIGNED_SHORT, true);
  bodyElements();
}

const turningOf = ({ across, upward, toEye }) => [0, 1, 2].flatMap((k) => [across[k], upward[k], toEye[k]]);

function drawBody(camera, eye) {
  use(lit, camera, box[0], size);
  gl.uniformMatrix3fv(lit.uniforms.turning, false, turningOf(eye));
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

const TURNS = Array.from({ length: 72 }, (_, n) => 2 * Math.PI * n / 72);

// Draw a sphere: without perspective it is a disk that faces the eye.
function drawBall(camera, { center, radius }, eye) {
  const rim = TURNS.map((turn) => sum(sum(center, eye.across, radius * Math.cos(turn)), eye.upward, radius * Math.sin(turn)));
  gl.enable(gl.BLEND);
  gl.depthMask(false);
  drawFlat(camera, rim, gl.TRIANGLE_FAN, [...colour("#a3b6c4"), 0.3]);
  gl.depthMask(true);
  gl.disable(gl.BLEND);
  drawFlat(camera, rim, gl.LINE_LOOP, [...colour("#667e90"), 1]);
}

// Return x @ turn for each vector x, three numbers each.
function turned(vectors, turn) {
  return Float32Array.from(vectors, (_, k) => [0, 1, 2].reduce((total, row) => total + vectors[k - k % 3 + row] * turn[row][k % 3], 0));
}

// Draw the mesh of an obstacle.
function drawMesh(camera, eye, { number, turn, by }) {
  const { corners, normals } = data.solids[number];
  use(lit, camera, by, [1, 1, 1]);
  gl.uniformMatrix3fv(lit.uniforms.turning, false, turningOf(eye));
  gl.uniform3fv(lit.uniforms.fixedColour, colour("#a3b6c4"));
  gl.vertexAttrib1f(lit.attributes.number, 0);
  gl.vertexAttrib1f(lit.attributes.fixing, 1);
  filled("corners", turned(corners, turn));
  attribute(lit, "position", "corners", 3, gl.FLOAT, false);
  filled("sides", turned(normals, turn));
  attribute(lit, "normal", "sides", 3, gl.FLOAT, false);
  gl.drawArrays(gl.TRIANGLES, 0, corners.length / 3);
}

// Draw an arrow, flat and turned towards the eye.
function drawArrow(camera, [tail, tip], eye) {
  const along = sum(tip, tail, -1), aside = scaled(unit(cross(along, eye.toEye)), Math.hypot(...along));
  const at = (far, wide) => sum(sum(tail, along, far), aside, wide);
  const shaft = [at(0, 0.045), at(0, -0.045), at(0.66, -0.045), at(0.66, 0.045)];
  drawFlat(camera, shaft, gl.TRIANGLE_FAN, [...colour("#cf5a3c"), 1]);
  drawFlat(camera, [at(0.64, 0.13), at(0.64, -0.13), tip], gl.TRIANGLES, [...colour("#cf5a3c"), 1]);
}

const CORNERS = [0, 1, 2, 3, 4, 5, 6, 7].map((n) => [n >> 2 & 1, n >> 1 & 1, n & 1].map((bit, k) => box[bit][k]));

function draw() {
  const density = Math.min(window.devicePixelRatio || 1, 2);
  canvas.width = Math.max(1, Math.round(canvas.clientWidth * density));
  canvas.height = Math.max(1, Math.round(canvas.clientHeight * density));
  gl.viewport(0, 0, canvas.width, canvas.height);
  gl.clearColor(0, 0, 0, 0);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  loadFrame();
  const eye = axesOfEye(), matrix = cameraMatrix(eye);
  const state = data.overlays[view.frame];
  for (const ground of state.grounds) drawGround(matrix, ground, eye);
  for (const mesh of state.meshes) drawMesh(matrix, eye, mesh);
  drawBody(matrix, eye);
  for (const corners of state.glass) drawGlass(matrix, corners);
  for (const ball of state.balls) drawBall(matrix, ball, eye);
  gl.clear(gl.DEPTH_BUFFER_BIT); // so that arrows are drawn in front
  for (const arrow of state.arrows) drawArrow(matrix, arrow, eye);
  showState();
}

let asked = false;
function redraw() {
  if (!asked) requestAnimationFrame(() => { asked = false; draw(); });
  asked = true;
}
