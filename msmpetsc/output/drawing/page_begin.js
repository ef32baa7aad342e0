// The start of the page, when all of it is known.

let extent;
async function begin() {
  if (data.run) showRun(data.run);
  if (!frames) {
    for (const id of ["player", "keys", "legend"]) byId(id).hidden = true;
    return;
  }
  const wide = points > 65535, packed = await inflated("triangles");
  triangles = new (wide ? Uint32Array : Uint16Array)(packed.buffer);
  fixing = await inflated("fixed");
  all = predicted(await inflated("positions"));
  numbers = data.streams.colours ? summed(await inflated("colours")) : null;
  extent = firstExtent();
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
