// One key for every action. Keys that belong to a text field or a slider keep their own meaning.

function makeKeys(viewer, navigation, panel, views, path, measure, white) {
  const { actions, modes } = panel;
  const KEYS = {
    f: actions.frame, r: actions.reset, l: actions.level, p: actions.picture, h: actions.help, '?': actions.help,
    1: () => { navigation.setFlying(false); say('Orbit'); }, 2: () => { navigation.setFlying(true); say('Fly'); },
    c: () => { element('compare').click(); }, m: () => measure.choose('distance'), i: () => white.choose(), g: () => measure.choose('ground'),
    k: path.add, ' ': () => { if (path.keys.length > 1) (path.playing ? path.stop() : path.play()); },
    n: () => views.go(views.current + 1), b: () => views.go(views.current - 1),
    // Replaces the pointer: does what a click in the middle of the picture does. If there is nothing to
    // click, the camera moves there.
    Enter: async () => {
      const { canvas } = viewer.renderer.gl, [x, y] = [canvas.clientWidth / 2, canvas.clientHeight / 2];
      if (!navigation.click(x, y) && !(await navigation.goTo(x, y))) say('There is no surface here');
    },
    v: () => { element('show-frusta').click(); },
    '.': () => step(1), ',': () => step(-1),
    '[': () => viewer.setLook({ strength: clamp(viewer.look.strength - 0.1, 0, 1) }), ']': () => viewer.setLook({ strength: clamp(viewer.look.strength + 0.1, 0, 1) }),
    '-': () => viewer.setLook({ water: clamp(viewer.look.water - 0.1, 0, 1) }), '=': () => viewer.setLook({ water: clamp(viewer.look.water + 0.1, 0, 1) }),
    '+': () => viewer.setLook({ water: clamp(viewer.look.water + 0.1, 0, 1) }),
    Escape: () => { if (white.picking) white.choose(); if (measure.tool) measure.choose(measure.tool); path.stop(); },
  };
  function step(by) {
    const mode = modes[(modes.indexOf(viewer.look.mode) + by + modes.length) % modes.length];
    viewer.setLook({ mode });
    say(`${MODES[mode].title}: ${MODES[mode].about}`);
  }
  addEventListener('keydown', event => {
    if (event.ctrlKey || event.metaKey || event.altKey || element('help').open) return;
    const field = event.target.closest?.('input:not([type=radio]):not([type=checkbox]), select, textarea');
    if (field) return;
    // Buttons and radio groups keep Space, Enter and the arrow keys.
    const control = event.target.closest?.('button, input, [role=tab], [role=slider]');
    if (control && (event.key === ' ' || event.key === 'Enter' || event.key.startsWith('Arrow'))) return;
    if (navigation.press(event)) { event.preventDefault(); return; }
    const act = KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (act) { act(); event.preventDefault(); }
  });
}
