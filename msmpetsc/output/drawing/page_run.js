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
