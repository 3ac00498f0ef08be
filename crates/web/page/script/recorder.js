// Records the path as a film from the canvas while it plays (WebM, as the browser encodes it). For exact
// frames use `use3d render --path`.

function makeRecorder(viewer, path) {
  const button = element('record'), canvas = viewer.renderer.gl.canvas;
  const kind = ['video/webm;codecs=vp9', 'video/webm;codecs=vp8', 'video/webm'].find(type => window.MediaRecorder?.isTypeSupported(type));
  const recorder = { kind };
  if (!kind || !canvas.captureStream) { button.hidden = true; return recorder; }
  recorder.record = () => new Promise(done => {
    const chunks = [], media = new MediaRecorder(canvas.captureStream(path.framesPerSecond), { mimeType: kind, videoBitsPerSecond: 12e6 });
    media.ondataavailable = event => { if (event.data.size) chunks.push(event.data); };
    media.onstop = () => { button.classList.remove('on'); button.textContent = 'Record'; done(new Blob(chunks, { type: 'video/webm' })); };
    path.show(path.keys[0].time);
    media.start(250);
    button.classList.add('on');
    button.textContent = 'Recording…';
    // A busy machine encodes late, so the film ends only after its first part has been encoded.
    const latest = 10000;
    const finish = waited => (chunks.length || waited > latest ? setTimeout(() => media.stop(), 120) : setTimeout(finish, 100, waited + 100));
    path.play(() => finish(0));
  });
  button.onclick = async () => {
    if (path.playing) { path.stop(); return; }
    const film = await recorder.record();
    download('swim.webm', 'video/webm', film);
    say(`Recorded ${path.length().toFixed(1)} s, ${(film.size / 1e6).toFixed(1)} MB`);
  };
  return recorder;
}
