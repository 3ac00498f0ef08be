// The modes that can be shown, named as in `use3d render --modes`, and the settings of the renderer for each:
//   graded   enhanced colours                water    it has water, whose amount can be chosen
//   objects  weight of the objects' light    veil     weight of the water's light, open water included
const MODES = {
  reconstruction: { title: 'Reconstruction', about: 'As photographed: the scene in its water', graded: false, water: true, objects: 1, veil: 1 },
  clear: { title: 'Clear', about: 'The water taken away', graded: false, water: false, objects: 1, veil: 0 },
  enhanced: { title: 'Enhanced', about: 'Enhanced colours, in the water', graded: true, water: true, objects: 1, veil: 1 },
  'enhanced-clear': { title: 'Enhanced, clear', about: 'Enhanced colours without the water', graded: true, water: false, objects: 1, veil: 0 },
  medium: { title: 'Water only', about: 'The light that the water itself sends', graded: false, water: true, objects: 0, veil: 1 },
  depth: { title: 'Depth', about: 'Near is bright, far is dark', graded: false, water: false, objects: 0, veil: 0, depth: true },
};

// The mode that a scene opens with: the one in which its enhancement was learnt. Colours that look right
// through water are too strong without it. A scene whose water the page cannot draw (`medium.of`) opens without it.
const openingMode = header => (header.enhancement ? (header.enhancement.water ? 'enhanced' : 'enhanced-clear') : header.medium.of ? 'clear' : 'reconstruction');

// The factors of a white balance for the colours of a look. The looks without water and `enhanced` have gains
// of their own; all others stay unchanged.
const NO_GAINS = [1, 1, 1];
const gainsOf = look => look.white?.[look.mode] ?? NO_GAINS;

// The modes that a scene has.
const modesOf = header => Object.keys(MODES).filter(name => {
  const mode = MODES[name];
  return (!mode.graded || header.enhancement) && (name !== 'medium' || header.medium.kind !== 'none') && !(mode.water && header.medium.of);
});
