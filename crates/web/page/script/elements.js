// Finds elements of the page by their id, and makes new ones.

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

// Shows a sentence at the bottom for a moment, and gives it to screen readers.
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

// Passes the text of an opened file to `read`, which returns what the file holds, in words.
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
