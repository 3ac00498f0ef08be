const TILE: u32 = 16u;
const PIXELS: u32 = 256u;
const LOG2_255: f32 = 7.9943533f;
const LOG2_E: f32 = 1.4426950f;
const LN_2: f32 = 0.69314718f;
const ALPHA_MAX: f32 = 0.999f;
const STOP_AT: f32 = 1e-4f;
const NEVER: u32 = 0x7fffffffu;
