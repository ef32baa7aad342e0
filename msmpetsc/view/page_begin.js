// The start of the page, when all of it is known.

let extent;
async function begin() {
  const packed = (await inflated("triangles")).buffer;
  triangles = new (points > 65535 ? Uint32Array : Uint16Array)(packed);
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
