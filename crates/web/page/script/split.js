// The divider between two modes: a handle that is dragged, or moved with the arrow keys.

function makeSplit(viewer) {
  const handle = element('split'), names = [element('name-left'), element('name-right')];
  const move = at => viewer.setCompare(viewer.compare, at);
  handle.addEventListener('pointerdown', event => { handle.setPointerCapture(event.pointerId); event.preventDefault(); handle.focus(); });
  handle.addEventListener('pointermove', event => {
    if (!handle.hasPointerCapture(event.pointerId)) return;
    const box = viewer.renderer.gl.canvas.getBoundingClientRect();
    move((event.clientX - box.left) / box.width);
  });
  handle.addEventListener('keydown', event => {
    const step = event.shiftKey ? 0.1 : 0.02;
    const to = { ArrowLeft: viewer.at - step, ArrowRight: viewer.at + step, Home: 0, End: 1 }[event.key];
    if (to === undefined) return;
    move(to);
    event.preventDefault();
    event.stopPropagation();
  });
  viewer.on('look', () => {
    const on = viewer.compare !== null;
    handle.hidden = !on;
    names.forEach(name => { name.hidden = !on; });
    if (!on) return;
    handle.style.left = `${100 * viewer.at}%`;
    handle.setAttribute('aria-valuenow', Math.round(100 * viewer.at));
    handle.setAttribute('aria-valuetext', `${Math.round(100 * viewer.at)} % ${MODES[viewer.compare].title}`);
    names[0].textContent = MODES[viewer.compare].title;
    names[1].textContent = MODES[viewer.look.mode].title;
  });
}
