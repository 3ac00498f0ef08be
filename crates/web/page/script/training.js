// The training that this page watches: its progress, its curves and its controls. When another scene or
// another stage begins, the page loads again. For the same scene it keeps the camera and the look.

const PLACE = 'use3d place';

function makeTraining(viewer, server) {
  if (!server) return null;
  const training = { status: null }, kept = JSON.parse(sessionStorage.getItem(PLACE) || 'null');
  sessionStorage.removeItem(PLACE);
  if (kept?.name === viewer.header.name) { viewer.camera.set(kept.camera); viewer.setLook(modesOf(viewer.header, true).includes(kept.look.mode) ? kept.look : {}); }
  let version = null;

  const number = (value, digits) => (Number.isFinite(value) ? value.toFixed(digits) : '–');
  const minutes = seconds => (!Number.isFinite(seconds) ? '–' : seconds < 90 ? `${Math.round(seconds)} s` : seconds < 5400 ? `${Math.round(seconds / 60)} min` : `${(seconds / 3600).toFixed(1)} h`);
  const command = async (name, share) => {
    try { show(await server.json('/do', { name, share })); } catch (error) { say(error.message); }
  };
  element('pause').onclick = () => command(training.status?.paused ? 'resume' : 'pause');
  element('stop').onclick = () => element('confirm-stop').showModal();
  element('keep-on').onclick = () => element('confirm-stop').close();
  element('do-stop').onclick = () => { element('confirm-stop').close(); command('stop'); };
  element('share').onchange = event => command('share', Number(event.target.value));

  function show(status) {
    training.status = status;
    if (status.generation !== server.generation) {
      sessionStorage.setItem(PLACE, JSON.stringify({ name: viewer.header.name, camera: viewer.camera.state(), look: viewer.look }));
      location.reload();
      return;
    }
    if (status.version !== version) { version = status.version; viewer.invalidate(); }
    const watched = status.steps > 0 || status.ended;
    element('tab-training').hidden = !watched;
    if (!watched) return;
    element('training-stage').textContent = status.label || '';
    element('training-state').textContent = status.ended ? status.words : status.stopping ? 'Stopping: writing a checkpoint…' : status.paused ? 'Paused' : status.training ? 'Training' : status.words || 'Between two stages';
    const bar = element('training-bar');
    [bar.max, bar.value] = [Math.max(1, status.steps), status.step];
    element('training-step').textContent = `${status.step.toLocaleString('en')} of ${status.steps.toLocaleString('en')} steps`;
    element('figure-loss').textContent = number(status.loss, 4);
    element('figure-psnr').textContent = Number.isFinite(status.psnr) ? `${number(status.psnr, 2)} dB` : '–';
    element('figure-gaussians').textContent = Number.isFinite(status.gaussians) ? status.gaussians.toLocaleString('en') : '–';
    element('figure-left').textContent = status.ended ? '–' : minutes(status.secondsLeft);
    element('training-shown').textContent = Number.isFinite(status.shownStep) ? `The picture shows step ${status.shownStep.toLocaleString('en')}.` : '';
    const running = status.controls && !status.ended && !status.stopping;
    element('training-controls').hidden = !status.controls;
    for (const id of ['pause', 'stop', 'share']) element(id).disabled = !running;
    element('pause').textContent = status.paused ? 'Resume' : 'Pause';
    if (document.activeElement !== element('share')) element('share').value = [...element('share').options].reduce((best, option) => (Math.abs(option.value - status.share) < Math.abs(best - status.share) ? option.value : best), 1);
    chart('chart-loss', status.curves.loss, true);
    chart('chart-psnr', status.curves.psnr, false);
    chart('chart-held-out', status.curves.heldOut, false);
    element('held-out-row').hidden = !Number.isFinite(status.heldOutPsnr);
    element('figure-held-out').textContent = `${number(status.heldOutPsnr, 2)} dB`;
  }

  // A curve as one line, with its smallest, last and largest value. A loss has a logarithmic axis.
  function chart(id, points, logarithmic) {
    const box = element(id), figure = box.closest('figure');
    const good = points.filter(([, v]) => Number.isFinite(v) && (!logarithmic || v > 0));
    figure.hidden = good.length < 2;
    if (figure.hidden) return;
    const value = v => (logarithmic ? Math.log(v) : v), [first, last] = [good[0][0], good[good.length - 1][0]];
    const values = good.map(([, v]) => value(v)), low = Math.min(...values), high = Math.max(...values), span = Math.max(high - low, 1e-9);
    const place = good.map(([step], i) => `${(280 * (step - first) / Math.max(1, last - first)).toFixed(1)},${(6 + 78 * (high - values[i]) / span).toFixed(1)}`);
    box.querySelector('polyline').setAttribute('points', place.join(' '));
    const text = v => (logarithmic ? v.toPrecision(2) : `${v.toFixed(1)} dB`), ends = [good.map(p => p[1]).reduce((a, b) => Math.max(a, b)), good.map(p => p[1]).reduce((a, b) => Math.min(a, b))];
    figure.querySelector('.most').textContent = text(ends[0]);
    figure.querySelector('.least').textContent = text(ends[1]);
    figure.querySelector('.steps').textContent = `step ${first.toLocaleString('en')} to ${last.toLocaleString('en')}`;
    box.setAttribute('aria-label', `${figure.querySelector('.what').textContent}: from ${text(good[0][1])} to ${text(good[good.length - 1][1])}`);
  }

  // After a request to stop, a program that no longer answers has stopped.
  const gone = () => (training.status?.stopping ? 'The training was stopped, and the program has ended. Run the same command to continue from its checkpoint.' : 'The program does not answer: it may have ended.');

  async function watch() {
    // A hidden page sends no requests, so it costs the training nothing.
    if (!document.hidden) {
      try {
        const status = await server.json('/state');
        server.lost = false;
        show(status);
      } catch (error) {
        server.lost = !error.status;
        // A training that has ended keeps its final text.
        if (!training.status?.ended) element('training-state').textContent = error.status ? error.message : gone();
      }
    }
    setTimeout(watch, server.lost ? 4000 : training.status?.training ? 1000 : 2000);
  }
  watch();
  return training;
}
