// Requests the order of a pose from the worker. One request is open at a time, and only the newest of the
// waiting ones is kept.

function makeWorker() {
  const source = document.getElementById('worker').textContent;
  return new Worker(URL.createObjectURL(new Blob([source], { type: 'text/javascript' })));
}

function makeSorter(sorted) {
  const worker = makeWorker();
  let busy = false, waiting = null, last = null, id = 0;
  const sorter = { milliseconds: 0, settled: () => !busy && !waiting };
  // Other Gaussians are in no order yet.
  sorter.load = centres => { worker.postMessage({ centres }, [centres.buffer]); last = null; };
  const send = pose => {
    busy = true;
    last = pose;
    worker.postMessage({ id: ++id, forward: pose.rotation[2], offset: dot(pose.rotation[2], pose.eye) });
  };
  worker.onmessage = ({ data }) => {
    sorter.milliseconds = data.milliseconds;
    busy = false;
    sorted(data.sorted);
    if (waiting) { const next = waiting; waiting = null; send(next); }
  };
  const same = (a, b) => a && a.eye.every((v, i) => v === b.eye[i]) && a.rotation[2].every((v, i) => v === b.rotation[2][i]);
  sorter.ask = pose => {
    if (busy) { waiting = same(last, pose) ? null : pose; } else if (!same(last, pose)) send(pose);
  };
  return sorter;
}
