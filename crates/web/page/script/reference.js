// Shows the program's own picture in place of the browser's, and how far the two differ. Only a page that the
// program serves has this. The next move or change of look hides the picture again.

const REFERENCE_SIDE = 1600;

function makeReference(viewer, server, picture) {
  const box = element('reference'), button = element('show-reference'), text = element('reference-text'), shown = element('reference-picture');
  box.hidden = !server || !viewer.drawsHere;
  const reference = { difference: null };
  if (box.hidden) return reference;
  const state = () => JSON.stringify([viewer.camera.state(), viewer.look, viewer.compare, viewer.at]);
  let of = null;
  reference.hide = () => {
    of = null;
    shown.hidden = true;
    button.setAttribute('aria-pressed', 'false');
    text.textContent = '';
  };
  viewer.on('frame', () => { if (of !== null && of !== state()) reference.hide(); });
  viewer.on('look', () => { if (of !== null && of !== state()) reference.hide(); });

  // Mean and 99.9 % quantile of the differences of colours in 8 bits, as shares of the display range. Depths
  // are not compared, because the two pictures scale them differently.
  const apart = (ours, theirs) => {
    const counts = new Uint32Array(256);
    let sum = 0, n = 0;
    for (let i = 0; i < theirs.length; i += 4) {
      for (let c = 0; c < 3; c++) {
        const difference = Math.abs(Math.round(255 * clamp(ours[i + c], 0, 1)) - theirs[i + c]);
        counts[difference]++;
        sum += difference;
        n++;
      }
    }
    let most = 255;
    for (let above = counts[255]; most > 0 && above <= 0.001 * n; above += counts[--most]);
    return { mean: sum / n / 255, most: most / 255 };
  };

  reference.show = async () => {
    const canvas = viewer.renderer.gl.canvas, { look } = viewer;
    const scale = Math.min(1, REFERENCE_SIDE / Math.max(canvas.clientWidth, canvas.clientHeight));
    const camera = viewer.camera.pinhole(Math.max(1, Math.round(scale * canvas.clientWidth)), Math.max(1, Math.round(scale * canvas.clientHeight)));
    const asked = state();
    text.textContent = 'The program draws…';
    const answer = await server.ask('/frame', { page: `${server.page} reference`, camera, mode: look.mode, left: null, at: 0.5, strength: look.strength, water: look.water, white: look.white ?? null, moving: false });
    if (answer.status !== 200) { reference.hide(); return; }
    const bitmap = await createImageBitmap(await answer.blob(), { colorSpaceConversion: 'none' });
    [shown.width, shown.height] = [bitmap.width, bitmap.height];
    const context = shown.getContext('2d', { willReadFrequently: true });
    context.drawImage(bitmap, 0, 0);
    bitmap.close();
    if (MODES[look.mode].depth) {
      reference.difference = null;
      text.textContent = `The program's own picture of ${MODES[look.mode].title.toLowerCase()}.`;
    } else {
      const theirs = context.getImageData(0, 0, shown.width, shown.height).data;
      reference.difference = apart(await picture(camera, look), theirs);
      const { mean, most } = reference.difference;
      text.textContent = `The program's own picture. The browser's is ${(100 * mean).toFixed(3)} % of the display range off on average, and 99.9 % of its values at most ${(100 * most).toFixed(1)} %.`;
    }
    if (asked !== state()) { reference.hide(); return; }
    of = asked;
    shown.hidden = false;
    button.setAttribute('aria-pressed', 'true');
    say("The program's own picture");
  };
  button.onclick = () => (of === null ? reference.show().catch(error => { reference.hide(); text.textContent = error.message; }) : reference.hide());
  return reference;
}
