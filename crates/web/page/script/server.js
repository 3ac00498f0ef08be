// The program that served this page, if there is one: `use3d view`, or a training that is watched. Requests
// carry the token after `#` in the address, which browsers never send to a server. `#TOKEN,server` makes the
// program draw the pictures, `#TOKEN,browser` this page. `webgl` in its place, or alone after `#` in a page
// without a server, makes the page draw by WebGL even without a graphics card.

const usesWebgl = () => /(^#|,)webgl$/.test(location.hash);

function makeServer() {
  if (JSON.parse(element('scene').textContent) !== null) return null;
  const [token, where] = location.hash.slice(1).split(',');
  const server = { page: Math.random().toString(36).slice(2), where, lost: false, generation: null };
  server.ask = async (path, body = {}) => {
    // Replaces the browser's own error for an address without a server, which does not help a visitor.
    const answer = await fetch(path, { method: 'POST', headers: { Authorization: `Bearer ${token}` }, body: JSON.stringify(body), cache: 'no-store' })
      .catch(() => { throw new Error('The program does not answer'); });
    if (!answer.ok) throw Object.assign(new Error(await answer.text()), { status: answer.status });
    return answer;
  };
  server.json = async (path, body) => (await server.ask(path, body)).json();
  // The description of the scene; waits until there is one.
  server.begin = async () => {
    for (;;) {
      const beginning = await server.json('/scene').catch(error => { if (error.status) throw error; return { waiting: 'The program does not answer; trying again' }; });
      if (beginning.waiting === undefined) { server.generation = beginning.generation; return beginning; }
      element('waiting').textContent = beginning.waiting;
      await new Promise(done => setTimeout(done, 700));
    }
  };
  return server;
}

// A browser without a graphics card draws so slowly that the program is quicker.
function drawsInSoftware() {
  const gl = document.createElement('canvas').getContext('webgl2'), info = gl?.getExtension('WEBGL_debug_renderer_info');
  const name = gl ? String(gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER)) : '';
  gl?.getExtension('WEBGL_lose_context')?.loseContext();
  return !gl || /swiftshader|llvmpipe|softpipe|software/i.test(name);
}

// Pictures drawn by the program, in place of a renderer. Only one request is open at a time, and only the
// newest of the waiting ones is kept. The next request starts when the last picture is on the screen.
function makeServerRenderer(canvas, server, shown) {
  const context = canvas.getContext('2d');
  let wanted = null, busy = false, patience = 500;
  async function work() {
    busy = true;
    while (wanted) {
      const asked = wanted;
      wanted = null;
      try {
        const answer = await server.ask('/frame', asked);
        [server.lost, patience] = [false, 500];
        if (answer.status !== 200) {
          // Too many pages requested pictures, so the screen still shows the last one.
          await new Promise(done => setTimeout(done, patience));
          wanted ??= asked;
          continue;
        }
        const picture = await createImageBitmap(await answer.blob());
        [canvas.width, canvas.height] = [picture.width, picture.height];
        context.drawImage(picture, 0, 0);
        picture.close();
        shown(asked.camera);
      } catch (error) {
        // After a program has ended, requests become less and less frequent.
        server.lost = !error.status;
        patience = Math.min(2 * patience, 15000);
        await new Promise(done => setTimeout(done, patience));
        wanted ??= asked;
      }
    }
    busy = false;
  }
  return {
    gl: { canvas, isContextLost: () => false },
    setOrder() {},
    settled: () => !busy || server.lost,
    ask(camera, look, left, at, moving) {
      wanted = { page: server.page, camera, mode: look.mode, left: left?.mode ?? null, at, strength: look.strength, water: look.water, white: look.white ?? null, moving };
      if (!busy) work();
    },
    depth: async camera => (await server.json('/depth', { page: server.page, camera })).depth ?? null,
  };
}
