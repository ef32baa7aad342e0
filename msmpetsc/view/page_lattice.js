// What of the lattice is shown: cells, each a little smaller than it is, and springs, behind the middle of the body.

const LATTICE = [`#version 300 es
in vec3 position; uniform mat4 camera; uniform mat3 turning; uniform vec3 low; uniform vec3 size;
out vec3 at;
void main() {
  vec3 point = low + size * position;
  at = turning * point;
  gl_Position = camera * vec4(point, 1.0);
}`, `#version 300 es
precision highp float;
in vec3 at; uniform vec4 paint; out vec4 pixel;
${LIGHT}
void main() {
  pixel = vec4(paint.rgb * light(normalize(cross(dFdx(at), dFdy(at)))), 1.0);
}`];
const SIDES = [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]; // of a cell, in VTK's order

let solid, nodes, cells, springs;
const offered = []; // of "cells", "springs"
const shown = new Set(); // of those offered

async function unpackLattice() {
  const count = data.lattice.nodes;
  nodes = predicted(await inflated("nodes"), count);
  cells = await numbersOf("cells", count);
  springs = await numbersOf("springs", count);
  if (cells.length) offered.push("cells");
  if (springs.length) offered.push("springs");
}

function startLattice() {
  solid = program(LATTICE);
  const sides = SIDES.flatMap(([a, b, c, d]) => [a, b, c, a, c, d]), all = new Uint32Array(36 * cells.length / 8);
  for (let cell = 0; cell < cells.length / 8; cell++) sides.forEach((corner, k) => { all[36 * cell + k] = 8 * cell + corner; });
  filled("cellSides", all, gl.ELEMENT_ARRAY_BUFFER);
  filled("springs", Uint32Array.from(springs), gl.ELEMENT_ARRAY_BUFFER);
}

function loadLattice(frame) {
  const count = 3 * data.lattice.nodes, at = nodes.subarray(count * frame, count * (frame + 1));
  filled("nodes", at);
  const corners = new Float32Array(3 * cells.length), kept = data.lattice.shrunk / 65535, moved = (1 / 65535 - kept) / 8;
  for (let cell = 0; cell < cells.length; cell += 8)
    for (let axis = 0; axis < 3; axis++) {
      let total = 0;
      for (let k = 0; k < 8; k++) total += at[3 * cells[cell + k] + axis];
      for (let k = 0; k < 8; k++) corners[3 * (cell + k) + axis] = kept * at[3 * cells[cell + k] + axis] + moved * total;
    }
  filled("cells", corners);
}

function drawLattice(camera, eye) {
  const [low, high] = data.lattice.box, extent = sum(high, low, -1);
  if (shown.has("cells")) {
    use(solid, camera, low, extent);
    gl.uniformMatrix3fv(solid.uniforms.turning, false, turningOf(eye));
    attribute(solid, "position", "cells", 3, gl.FLOAT, false);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffers.cellSides);
    let first = 0;
    for (const { cells: count, colour: paint } of data.lattice.kinds) {
      gl.uniform4fv(solid.uniforms.paint, [...colour(paint), 1]);
      gl.drawElements(gl.TRIANGLES, 36 * count, gl.UNSIGNED_INT, 4 * 36 * first);
      first += count;
    }
  }
  if (shown.has("springs")) {
    use(flat, camera, low, extent);
    gl.uniform4fv(flat.uniforms.paint, [...colour(data.lattice.springColour), 1]);
    attribute(flat, "position", "nodes", 3, gl.UNSIGNED_SHORT, true);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffers.springs);
    gl.drawElements(gl.LINES, springs.length, gl.UNSIGNED_INT, 0);
  }
}

function makeSwitches() {
  for (const name of offered) {
    const label = document.createElement("label"), box = document.createElement("input");
    Object.assign(box, { type: "checkbox", id: `show-${name}` });
    box.addEventListener("change", () => setShown(name, box.checked));
    label.append(box, name);
    byId("switches").append(label);
  }
  byId("switches").hidden = !offered.length;
  byId("toggles").textContent = offered.map((name) => ` · ${name[0].toUpperCase()}: ${name}`).join("");
}

function setShown(name, is) {
  if (!offered.includes(name)) return;
  if (is) shown.add(name); else shown.delete(name);
  changed();
}
