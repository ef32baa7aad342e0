"use strict";
// The data of a page and its unpacked frames. page_drawing.js and page_steering.js continue this script.

const data = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const canvas = byId("view"), slider = byId("slider"), play = byId("play"), speedChoice = byId("speed");
const frames = data.times.length, points = data.points;
const box = data.box, size = box[1].map((high, k) => Math.max(high - box[0][k], 1e-30));
const middle = box[0].map((low, k) => (low + box[1][k]) / 2), reach = Math.max(...size);
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

// Return frames of a length from their differences, in place.
function summed(values, length) {
  for (let k = length; k < values.length; k++) values[k] += values[k - length];
  return values;
}
