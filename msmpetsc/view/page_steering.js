// Around the picture: legend, player, time, mouse, fingers and keys.

// Legend, player and time

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

function legendEntry({ kind, text, colour: paint, ticks }) {
  const entry = document.createElement("span"), mark = document.createElement(kind === "arrow" ? "b" : "i");
  mark.className = kind;
  if (kind === "arrow") { mark.textContent = "➞"; mark.style.color = paint; }
  else if (kind === "bar") mark.style.background = `linear-gradient(to right, ${data.scale.filter((_, k) => k % 15 === 0).map((rgb) => `rgb(${rgb})`)})`;
  else mark.style.background = paint;
  for (const [share, number] of ticks) {
    const tick = document.createElement("small");
    tick.textContent = number;
    tick.style.left = `${100 * share}%`;
    mark.append(tick);
  }
  entry.append(mark, text);
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
  for (const id of ["player", "playing"]) byId(id).hidden = frames < 2;
  const factors = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000];
  const rates = [...new Set([...factors, ...factors.map((factor) => 1 / factor), data.speed])].sort((a, b) => b - a);
  for (const rate of rates) {
    const option = new Option(rate === 1 ? "real time" : rate > 1 ? `${rate} × faster` : `${Math.round(1 / rate)} × slower`, rate);
    option.selected = rate === data.speed;
    speedChoice.append(option);
  }
}

// Time

// start of the playback: clock [ms] and time of the result [s]
let begun = null;
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
  redraw();
}

function goTo(frame) {
  view.frame = Math.min(frames - 1, Math.max(0, Math.round(frame) || 0));
  begun = null;
  redraw();
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
  redraw();
});
for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
canvas.addEventListener("contextmenu", (event) => event.preventDefault());
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  nearer(Math.exp(-0.001 * event.deltaY * (event.deltaMode ? 30 : 1)));
  redraw();
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
  "+": () => { nearer(1.2); redraw(); },
  "-": () => { nearer(1 / 1.2); redraw(); },
  ArrowUp: () => { turn(0, 12); redraw(); },
  ArrowDown: () => { turn(0, -12); redraw(); },
  r: () => { Object.assign(view, { yaw: 0, pitch: 0, zoom: 1, right: 0, up: 0 }); redraw(); },
};
addEventListener("keydown", (event) => {
  const act = KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (!act || event.ctrlKey || event.metaKey || event.altKey || event.target === speedChoice) return;
  event.preventDefault();
  act();
});
addEventListener("resize", redraw);
dark.addEventListener("change", redraw);

// Start of the page, once all scripts are read

let extent;
async function begin() {
  const packed = (await inflated("triangles")).buffer;
  triangles = new (points > 65535 ? Uint32Array : Uint16Array)(packed);
  fixing = summed(await inflated("fixed"), points);
  all = summed(new Uint16Array((await inflated("positions")).buffer), 3 * points);
  numbers = summed(await inflated("colours"), points);
  extent = firstExtent();
  start();
  makeLegend();
  makePlayer();
  draw();
  document.documentElement.dataset.ready = "1";
}
begin().catch((error) => {
  byId("message").hidden = false;
  byId("message").textContent = `This page cannot be shown: ${error.message}`;
});
