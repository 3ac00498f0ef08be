// The cameras of the photographs, and the photograph beside the picture.

function makeViews(viewer, overlay) {
  const { header, camera } = viewer, cameras = header.cameras, list = element('cameras');
  const views = { current: -1, showPhoto: true, showFrusta: element('show-frusta').checked = !!header.points };
  element('no-cameras').hidden = cameras.length > 0;
  element('camera-tools').hidden = cameras.length === 0;
  list.hidden = cameras.length === 0;

  // The list of the photographs; `fill` makes it again when they have been read.
  views.fill = () => list.replaceChildren(...cameras.map((view, i) => {
    const held = view.heldOut ? make('span', { class: 'badge', title: 'not seen in training' }, 'held out') : '';
    const picture = view.photo ? make('img', { src: view.photo, alt: '', loading: 'lazy' }) : make('span', { class: 'blank' });
    return make('li', {}, make('button', { type: 'button', class: 'card', 'aria-current': String(i === views.current), onclick: () => views.go(i) }, picture, make('span', { class: 'name' }, view.name), held));
  }));
  views.fill();

  // The photograph stays beside the picture while the camera is at its place.
  const photo = element('photo');
  function showPhoto() {
    const view = cameras[views.current], there = view && norm(subtract(view.eye, camera.eye)) < 0.02 * camera.reach;
    photo.hidden = !(views.showPhoto && view?.photo && (there || viewer.flight.busy()));
    if (photo.hidden) return;
    const [image, caption] = [element('photo-image'), element('photo-name')];
    if (image.getAttribute('src') === view.photo) return;
    image.src = view.photo;
    image.alt = `Photograph ${view.name}`;
    // On the right of the divider stands the photograph in the light of the scene, where there is one.
    enhanced.hidden = divider.hidden = !view.enhanced;
    if (view.enhanced) { enhanced.src = view.enhanced; enhanced.alt = `Photograph ${view.name}, enhanced`; }
    caption.textContent = view.enhanced ? `Photograph | enhanced: ${view.name}` : `Photograph ${view.name}`;
  }
  const [enhanced, divider] = [element('photo-enhanced'), element('photo-divider')];
  divider.oninput = () => { enhanced.style.clipPath = `inset(0 0 0 ${divider.value}%)`; };
  divider.oninput();
  viewer.on('frame', showPhoto);

  views.go = (i, seconds) => {
    if (!cameras.length) return;
    views.current = (i + cameras.length) % cameras.length;
    const view = cameras[views.current];
    viewer.fly(camera.atView(view), seconds);
    list.querySelectorAll('button').forEach((button, k) => button.setAttribute('aria-current', k === views.current));
    list.children[views.current]?.scrollIntoView({ block: 'nearest' });
    say(`Photograph ${views.current + 1} of ${cameras.length}: ${view.name}`);
  };
  element('previous-view').onclick = () => views.go(views.current - 1);
  element('next-view').onclick = () => views.go(views.current + 1);
  element('show-photo').onchange = event => { views.showPhoto = event.target.checked; showPhoto(); };
  element('show-frusta').onchange = event => { views.showFrusta = event.target.checked; viewer.invalidate(); };
  element('hide-photo').onclick = () => { element('show-photo').checked = views.showPhoto = false; showPhoto(); };

  const depth = 0.05 * camera.reach;
  const corners = view => [[0, 0], [1, 0], [1, 1], [0, 1]].map(([u, v]) => {
    const x = (u * view.width - view.lens[2]) / view.lens[0], y = (v * view.height - view.lens[3]) / view.lens[1];
    return add(view.eye, scaled(add(view.rotation[2], add(scaled(view.rotation[0], x), scaled(view.rotation[1], y))), depth));
  });
  const frusta = cameras.map(view => {
    const [a, b, c, d] = corners(view), e = view.eye;
    return [a, b, c, d, a, e, b, e, c, e, d];
  });
  overlay.add(canvas => {
    if (!views.showFrusta) return;
    frusta.forEach((line, i) => {
      if (norm(subtract(cameras[i].eye, camera.eye)) < 0.02 * camera.reach) return;
      canvas.line(line, i === views.current ? '#ffd166' : cameras[i].heldOut ? '#ff9e7acc' : '#7fe3f5cc', i === views.current ? 2.5 : 1.3);
    });
  });
  // A click moves the camera to the photograph whose eye is nearest to the pointer.
  views.pick = (x, y, width, height) => {
    if (!views.showFrusta) return false;
    let best = [18, -1];
    cameras.forEach((view, i) => {
      const p = camera.project(view.eye, width, height), far = p ? Math.hypot(p[0] - x, p[1] - y) : Infinity;
      if (far < best[0]) best = [far, i];
    });
    if (best[1] >= 0) views.go(best[1]);
    return best[1] >= 0;
  };

  return views;
}
