// Puts the page together. Scripts control the page through `window.use3d`; its `ready` resolves as soon as a
// picture is shown.

async function start() {
  const canvas = element('view'), progress = element('progress');
  const server = makeServer(), scene = await loadScene(server);
  if (server) {
    document.title = element('title').textContent = scene.header.name;
    element('about-page').textContent = scene.server ? 'The program that serves this page draws its pictures.' : 'The scene comes from the program that serves this page.';
  }
  const viewer = makeViewer(canvas, scene), overlay = makeOverlay(element('overlay'), viewer);
  const navigation = makeNavigation(canvas, viewer), panel = makePanel(viewer, navigation, server);
  const views = makeViews(viewer, overlay), path = makePath(viewer, overlay), recorder = makeRecorder(viewer, path);
  const measure = makeMeasure(viewer, overlay), saved = makeSaved(viewer, measure), white = makeWhite(viewer, server, picture);
  makeSplit(viewer);
  makeKeys(viewer, navigation, panel, views, path, measure, white);
  navigation.click = (x, y) => white.click(x, y) || measure.click(x, y) || views.pick(x, y, canvas.clientWidth, canvas.clientHeight);
  navigation.picking = () => white.picking || measure.tool !== null;
  navigation.interrupted = () => path.stop();
  navigation.setFlying(false);
  canvas.addEventListener('webglcontextlost', event => { event.preventDefault(); problem('The graphics driver stopped. Load the page again to continue.'); });
  viewer.setLook({});
  viewer.setCompare(null);
  const training = makeTraining(viewer, server);
  views.current = openingView(scene.header.cameras);
  await new Promise(done => { viewer.on('frame', done); });
  performance.mark('use3d first picture');
  progress.hidden = true;
  document.body.classList.add('ready');
  element('slow').hidden = !viewer.software;
  // A phone has no room for the line.
  if (viewer.software && !element('slow').offsetParent) say(element('slow').textContent);
  if (scene.complete) {
    scene.complete().then(all => {
      if (all) viewer.load(all);
      views.fill();
      viewer.complete = true;
    }).catch(error => problem(`A part of this scene cannot be shown: ${error.message}.`));
  }
  const settled = async () => {
    for (;;) {
      viewer.sorter.ask(viewer.camera.state());
      if (viewer.settled()) return;
      await new Promise(done => setTimeout(done, 5));
    }
  };
  // The float picture (RGBA, rows from the top) of a camera { eye, rotation, lens, width, height } and a look
  // { mode, strength, water, white }, or of a box of that picture.
  async function picture(view, look, box = null) {
    if (viewer.software) {
      const whole = await viewer.renderer.picture(view, look);
      if (!box) return whole;
      const [left, top, width, height] = box, part = new Float32Array(4 * width * height);
      for (let y = 0; y < height; y++) part.set(whole.subarray(4 * ((top + y) * view.width + left), 4 * ((top + y) * view.width + left + width)), 4 * width * y);
      return part;
    }
    const { held } = viewer;
    viewer.held = true;
    viewer.sorter.ask(view);
    while (!viewer.sorter.settled()) await new Promise(done => setTimeout(done, 1));
    const picture = viewer.renderer.picture(view, look, box);
    viewer.held = held;
    viewer.invalidate();
    return picture;
  }
  const reference = makeReference(viewer, server, picture);
  return { viewer, training, navigation, views, saved, path, recorder, measure, white, panel, reference, scene: scene.header, settled, picture };
}

function problem(text) {
  const box = element('problem');
  box.textContent = text;
  box.hidden = false;
  element('progress').hidden = true;
}

window.use3d = { ready: start().then(page => Object.assign(window.use3d, page)) };
window.use3d.ready.catch(error => {
  const old = typeof DecompressionStream === 'undefined' ? ' This browser is too old: Chrome 80, Firefox 113, Safari 16.4 or later can show it.' : '';
  problem(`This scene cannot be shown: ${error.message}.${old}`);
});
