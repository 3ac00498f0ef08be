// The visitor's own views under a name: place, look and comparison. Their file also holds the up direction
// and the length of a unit; `use3d export --web --views FILE` puts it into the page.

const VIEWS_FORMAT = '3d-use views';

function makeSaved(viewer, measure) {
  const { header, camera } = viewer, { frame } = header, saved = { views: [] }, list = element('saved-views');
  const go = view => {
    const available = modesOf(header), mode = available.includes(view.mode) ? view.mode : 'reconstruction';
    viewer.setLook({ mode, strength: view.strength, water: view.water });
    viewer.setCompare(available.includes(view.compare) ? view.compare : null, view.at);
    viewer.fly(view);
    say(view.name);
  };
  saved.changed = () => {
    list.replaceChildren(...saved.views.map((view, i) => make('li', { class: 'row' },
      make('button', { type: 'button', class: 'link', onclick: () => go(view) }, view.name),
      make('button', { type: 'button', class: 'small', 'aria-label': `Delete the view ${view.name}`, onclick: () => { saved.views.splice(i, 1); saved.changed(); } }, '✕'))));
    element('no-saved').hidden = saved.views.length > 0;
    element('save-views').disabled = saved.views.length === 0;
  };
  saved.add = name => {
    saved.views.push({ name, ...camera.state(), ...viewer.look, compare: viewer.compare, at: viewer.at });
    saved.changed();
    say(`Saved the view ${name}`);
  };
  element('save-view').onsubmit = event => {
    event.preventDefault();
    saved.add(element('view-name').value.trim() || `View ${saved.views.length + 1}`);
    element('view-name').value = '';
  };

  // Directions turn with the frame and keep their length.
  const turned = (row, up) => dot(frame.rotation.slice(3 * row, 3 * row + 3), up);
  const turnedBack = (column, up) => [0, 1, 2].reduce((sum, row) => sum + frame.rotation[3 * row + column] * up[row], 0);
  saved.json = () => JSON.stringify({
    format: VIEWS_FORMAT, version: 1, frame: 'colmap', up: [0, 1, 2].map(k => turnedBack(k, camera.up)), metres_per_unit: measure.metresPerUnit,
    views: saved.views.map(view => ({ name: view.name, ...shotForFile(view, frame), ...(view.compare ? { compare: view.compare } : {}), at: view.at })),
  }, null, 1);
  saved.take = file => {
    checkFile(file, VIEWS_FORMAT, 'file of views', 'views');
    saved.views.push(...file.views.map((view, i) => ({
      ...shotOfFile(view, frame, `view ${i + 1}`), name: String(view.name || `View ${i + 1}`), compare: MODES[view.compare] ? view.compare : null, at: Number.isFinite(view.at) ? clamp(view.at, 0, 1) : 0.5,
    })));
    const { up } = file;
    if (Array.isArray(up) && up.length === 3 && up.every(Number.isFinite)) camera.up = camera.upright = unit([0, 1, 2].map(k => turned(k, up)), camera.up);
    if (file.metres_per_unit > 0 && !measure.metresPerUnit) { measure.metresPerUnit = file.metres_per_unit; measure.list(); }
    saved.changed();
  };
  element('save-views').onclick = () => download(`${header.name}-views.json`, 'application/json', saved.json());
  opensFiles('open-views', text => { const before = saved.views.length; saved.take(JSON.parse(text)); return `${saved.views.length - before} views`; });
  saved.changed();
  if (header.saved) saved.take(header.saved);
  return saved;
}
