// The modes that can be shown, named as in `use3d render --modes`, and the settings of the renderer for each:
//   graded   enhanced colours                water    it has water, whose amount can be chosen
//   objects  weight of the objects' light    veil     weight of the water's light, open water included
//   expert   a page to send does not offer it, unless it opens with it
const MODES = {
  reconstruction: { title: 'As photographed', about: 'The colours that the camera saw, through all of the water', graded: false, water: true, objects: 1, veil: 1 },
  enhanced: { title: 'Enhanced', about: 'Corrected colours, through the water that is left', graded: true, water: true, objects: 1, veil: 1 },
  clear: { title: 'Without the water', about: 'The water is taken away. Near things are right; far colours are a guess', graded: false, water: false, objects: 1, veil: 0 },
  'enhanced-clear': { title: 'Enhanced, no water', about: 'For experts. The colours were corrected through water and are too strong without it: far things become too red', graded: true, water: false, objects: 1, veil: 0, expert: true },
  medium: { title: 'Only the water', about: 'The light that the water itself sends', graded: false, water: true, objects: 0, veil: 1, expert: true },
  depth: { title: 'Distance', about: 'Near is bright, far is dark', graded: false, water: false, objects: 0, veil: 0, depth: true },
};

// The mode that a scene opens with: the one in which its enhancement was learnt. Colours that look right
// through water are too strong without it. A scene whose water the page cannot draw (`medium.of`) opens without it.
const openingMode = header => (header.enhancement ? (header.enhancement.water ? 'enhanced' : 'enhanced-clear') : header.medium.of ? 'clear' : 'reconstruction');

// The factors of a white balance for the colours of a look. The looks without water and `enhanced` have gains
// of their own; all others stay unchanged.
const NO_GAINS = [1, 1, 1];
const gainsOf = look => look.white?.[look.mode] ?? NO_GAINS;

// The modes that a scene has. `all` also offers those for experts. The points of a capture have two.
const modesOf = (header, all) => Object.keys(MODES).filter(name => {
  const mode = MODES[name];
  if (header.points) return name === 'reconstruction' || name === 'depth';
  return (!mode.graded || header.enhancement) && (name !== 'medium' || header.medium.kind !== 'none') && !(mode.water && header.medium.of) && (all || !mode.expert || name === openingMode(header));
});
