// The scene's data: parts in base64 -> gzip -> sections of bytes -> textures.
//
// Numbers are stored byte by byte in planes (the first byte of every Gaussian, then the second ...), which
// compresses better. Here the bytes are put side by side again, in the layout that the shaders read. The
// header lists the sections in their order.

const GEOMETRY_BYTES = 48, HARMONIC_BYTES = 48, PER_ROW = 512;

function bytesOfBase64(text) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
  const raw = atob(text), bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  return bytes;
}

async function unpacked(parts) {
  const packed = new Blob(parts.map(bytesOfBase64)).stream().pipeThrough(new DecompressionStream('gzip'));
  return new Uint8Array(await new Response(packed).arrayBuffer());
}

// Makes `count` records of `stride` bytes from planes; `place(k)` is the position of byte k in a record.
function records(planes, count, stored, stride, rows, place) {
  const out = new Uint8Array(rows * PER_ROW * stride);
  for (let k = 0; k < stored; k++) {
    const plane = planes.subarray(k * count, (k + 1) * count);
    for (let i = 0, to = place(k); i < count; i++, to += stride) out[to] = plane[i];
  }
  return out;
}

function sceneData(header, sections) {
  const count = header.count, rows = Math.max(1, Math.ceil(count / PER_ROW));
  const geometry = records(sections.geometry, count, GEOMETRY_BYTES, GEOMETRY_BYTES, rows, k => k);
  const planes = sections.harmonics, stored = header.harmonicBytes;
  // The last two stored bytes are the scale; the shader reads it at the end of the record.
  const harmonics = planes && stored > 0
    ? records(planes, count, stored, HARMONIC_BYTES, rows, k => (k < stored - 2 ? k : HARMONIC_BYTES - stored + k))
    : null;
  const floats = new Float32Array(geometry.buffer), centres = new Float32Array(3 * count);
  for (let i = 0; i < count; i++) for (let a = 0; a < 3; a++) centres[3 * i + a] = floats[12 * i + a];
  return { header, count, rows, geometry, harmonics, centres, cube: sections.cube };
}

// Parts are elements of the page, or scripts beside the page have put them into a list; both are in the order
// of the sections. A page from a server gets them from there, or the server draws the pictures.
async function loadScene(server) {
  if (server) {
    const { header, drawn } = await server.begin();
    if (drawn === 'server' || server.where === 'server' || (server.where !== 'browser' && drawsInSoftware())) return { header, server };
    const sections = {};
    for (const { name } of header.sections) {
      const packed = (await server.ask('/section', { name })).body.pipeThrough(new DecompressionStream('gzip'));
      sections[name] = new Uint8Array(await new Response(packed).arrayBuffer());
    }
    return sceneData(header, sections);
  }
  const header = JSON.parse(element('scene').textContent);
  const parts = window.use3dParts || [...document.querySelectorAll('script[data-part]')].map(s => s.textContent.trim());
  const sections = {};
  let next = 0;
  for (const { name, parts: count } of header.sections) {
    if (parts.length < next + count) throw new Error('a part of its data is missing; keep the folder that came with the page beside it');
    sections[name] = await unpacked(parts.slice(next, next + count));
    next += count;
  }
  return sceneData(header, sections);
}
