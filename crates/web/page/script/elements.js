// Elements of the page by name, and making new ones.

const element = id => document.getElementById(id);

function make(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith('on')) made.addEventListener(name.slice(2), value);
    else if (value === true) made.setAttribute(name, '');
    else if (value !== false && value !== null && value !== undefined) made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}

// A sentence for who cannot see the picture, and for a moment at the bottom for who can.
let quiet = 0;
function say(text) {
  element('live').textContent = text;
  const note = element('note');
  note.textContent = text;
  note.classList.add('shown');
  clearTimeout(quiet);
  quiet = setTimeout(() => note.classList.remove('shown'), 2600);
}

function download(name, type, content) {
  const link = make('a', { href: URL.createObjectURL(new Blob([content], { type })), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

// What an opened file holds is taken up by `read`, which says in words what it was.
function opensFiles(id, read) {
  element(id).onchange = async event => {
    const [file] = event.target.files;
    event.target.value = '';
    if (!file) return;
    try { say(`${file.name}: ${read(await readFile(file))}`); } catch (error) { say(`${file.name}: ${error.message}`); }
  };
}

const readFile = file => new Promise((done, failed) => {
  const reader = new FileReader();
  reader.onload = () => done(reader.result);
  reader.onerror = () => failed(reader.error);
  reader.readAsText(file);
});
