// The start of the page, when all of it is known.

let extent;
async function begin() {
  triangles = await numbersOf("triangles", points);
  fixing = await inflated("fixed");
  all = predicted(await inflated("positions"), points);
  numbers = data.streams.colours ? summed(await inflated("colours")) : null;
  extent = firstExtent();
  if (data.lattice) await unpackLattice();
  start();
  makeLegend();
  makeSwitches();
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
