// The panel: its tabs, the choice of mode and its sliders, facts about the scene. Also the row of buttons
// below the picture. `server` is the program, if it serves the page.

function makePanel(viewer, navigation, server) {
  const { header, camera } = viewer, modes = modesOf(header, server);
  if (header.points) Object.assign(MODES.reconstruction, { title: 'Points', about: 'The places that several photographs share, and the cameras. `use3d run` makes a scene of them.' });

  // Tabs follow the ARIA pattern: arrow keys move between them, and only one is in the tab order.
  const tabs = [...document.querySelectorAll('[role=tab]')];
  const open = tab => {
    tabs.forEach(other => {
      const on = other === tab;
      other.setAttribute('aria-selected', on);
      other.tabIndex = on ? 0 : -1;
      const panel = element(other.getAttribute('aria-controls'));
      panel.hidden = !on;
      panel.classList.toggle('open', on);
    });
    document.body.classList.remove('folded');
    element('fold').setAttribute('aria-expanded', 'true');
    viewer.invalidate();
  };
  tabs.forEach((tab, i) => {
    tab.onclick = () => open(tab);
    tab.onkeydown = event => {
      const to = { ArrowRight: i + 1, ArrowLeft: i - 1, Home: 0, End: tabs.length - 1 }[event.key];
      if (to === undefined) return;
      const next = tabs[(to + tabs.length) % tabs.length];
      open(next);
      next.focus();
      event.preventDefault();
      event.stopPropagation();
    };
  });
  element('fold').onclick = () => {
    const folded = document.body.classList.toggle('folded');
    element('fold').setAttribute('aria-expanded', !folded);
    viewer.invalidate();
  };

  // Modes as radio buttons, and the mode to compare with.
  const choices = element('modes'), left = element('compare-mode');
  modes.forEach((name, i) => {
    choices.append(make('label', { class: 'choice', title: MODES[name].about },
      make('input', { type: 'radio', name: 'mode', value: name, onchange: () => { viewer.setLook({ mode: name }); say(`${MODES[name].title}: ${MODES[name].about}`); } }),
      make('span', {}, MODES[name].title)));
    left.append(make('option', { value: name, selected: i === 0 }, MODES[name].title));
  });
  const compare = element('compare');
  compare.onchange = () => {
    // Two equal halves would show no difference.
    if (compare.checked && left.value === viewer.look.mode) left.value = modes[(modes.indexOf(viewer.look.mode) + 1) % modes.length];
    viewer.setCompare(compare.checked ? left.value : null);
    if (compare.checked) say(`${MODES[left.value].title} on the left, ${MODES[viewer.look.mode].title} on the right`);
  };
  left.onchange = () => { if (compare.checked) viewer.setCompare(left.value); };

  const percent = (id, name) => {
    const slider = element(id);
    slider.oninput = () => viewer.setLook({ [name]: Number(slider.value) / 100 });
    return slider;
  };
  const strength = percent('strength', 'strength'), water = percent('water', 'water');
  const fov = element('fov');
  fov.oninput = () => { camera.fov = Number(fov.value); viewer.moved(); };
  viewer.on('look', () => {
    const shown = [viewer.look.mode, viewer.compare].filter(Boolean).map(name => MODES[name]);
    choices.querySelectorAll('input').forEach(input => { input.checked = input.value === viewer.look.mode; });
    compare.checked = viewer.compare !== null;
    element('compare-with').hidden = !compare.checked;
    if (viewer.compare) left.value = viewer.compare;
    element('about-mode').textContent = MODES[viewer.look.mode].about;
    strength.value = Math.round(100 * viewer.look.strength);
    water.value = Math.round(100 * viewer.look.water);
    element('strength-value').textContent = `${strength.value} %`;
    element('water-value').textContent = `${water.value} %`;
    strength.disabled = !shown.some(mode => mode.graded);
    water.disabled = !shown.some(mode => mode.water);
    element('strength-row').hidden = !header.enhancement;
    element('water-row').hidden = header.medium.kind === 'none';
  });
  viewer.on('frame', () => {
    if (document.activeElement !== fov) fov.value = Math.round(camera.fov);
    element('fov-value').textContent = `${Math.round(camera.fov)}°`;
  });

  // The row of buttons.
  const actions = {
    frame: () => viewer.fly(camera.framing()),
    reset: () => { camera.up = [...camera.upright]; viewer.fly(camera.home()); },
    level: () => viewer.fly(camera.levelled()),
    picture: () => savePicture(viewer),
    full: () => (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen?.()),
    help: () => { const dialog = element('help'); if (dialog.open) dialog.close(); else dialog.showModal(); },
  };
  for (const name in actions) element(`do-${name}`).onclick = actions[name];
  const [orbit, fly] = [element('do-orbit'), element('do-fly')];
  orbit.onclick = () => navigation.setFlying(false);
  fly.onclick = () => navigation.setFlying(true);
  navigation.changed.push(() => { orbit.setAttribute('aria-pressed', !navigation.flying); fly.setAttribute('aria-pressed', navigation.flying); });
  element('close-help').onclick = () => element('help').close();

  const water_ = { none: 'no water', global: 'one water everywhere', rbf: 'water that varies with place and direction', mlp: 'water that varies with direction',
    image: 'one water everywhere: the program lays it over the finished image, and this page in front of every Gaussian',
    seasplat: 'its water belongs to finished images, and this page shows the scene without it',
    uir: 'its water belongs to finished images, and this page shows the scene without it' };
  // For a guest: the photographs, their days, and the way of the camera from the first to the last.
  const { cameras, days, metresPerUnit } = header, dayText = day => new Date(day).toLocaleDateString('en-GB', { day: 'numeric', month: 'long', year: 'numeric', timeZone: 'UTC' });
  const swim = cameras.slice(1).reduce((sum, view, i) => sum + norm(subtract(view.eye, cameras[i].eye)), 0) / header.frame.scale;
  element('facts').textContent = [
    cameras.length ? `${cameras.length} photographs` : null, days.length ? [...new Set([days[0], days[days.length - 1]])].map(dayText).join(' to ') : null, metresPerUnit && cameras.length > 1 ? `a swim of ${(swim * metresPerUnit).toPrecision(2)} m` : null,
  ].filter(Boolean).join(' · ');
  element('facts').hidden = !element('facts').textContent;
  // The number of Gaussians changes during training, so it is left out.
  element('about-scene').textContent = header.points ? `${header.count.toLocaleString('en')} points of a capture; no scene yet.` : `${[header.sections.length ? `${header.count.toLocaleString('en')} Gaussians` : null, water_[header.medium.of ?? header.medium.kind], header.enhancement ? 'enhanced' : 'not enhanced'].filter(Boolean).join(' · ')}.`;
  return { actions, open: name => open(element(`tab-${name}`)), modes };
}

// Saves the picture on the screen as a PNG.
function savePicture(viewer) {
  viewer.renderer.gl.canvas.toBlob(blob => { if (blob) { download(`${viewer.header.name}-${viewer.look.mode}.png`, 'image/png', blob); say('Picture saved'); } });
}
