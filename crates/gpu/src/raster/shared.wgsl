const TILE: u32 = 16u;
const PIXELS: u32 = 256u;
const LOG2_255: f32 = 7.9943533f;
const LOG2_E: f32 = 1.4426950f;
const LN_2: f32 = 0.69314718f;
const ALPHA_MAX: f32 = 0.999f;
const STOP_AT: f32 = 1e-4f;
const NEVER: u32 = 0x7fffffffu;

// Sections of `kept`, in planes of the view's pixels: accumulation; three images of three planes each; final
// transmittance, the entry at which a pixel stopped, and depth. Floats are stored as their bits.
const KEPT_FIRST: u32 = 1u;
const KEPT_SECOND: u32 = 4u;
const KEPT_THIRD: u32 = 7u;
const KEPT_TRANSMITTANCE: u32 = 10u;
const KEPT_STOP: u32 = 11u;
const KEPT_DEPTH: u32 = 12u;
// Sections of `water`: the colour c_m, then k of attenuation and of backscatter, three planes each.
const K_ATTENUATION: u32 = 3u;
const K_BACKSCATTER: u32 = 6u;
