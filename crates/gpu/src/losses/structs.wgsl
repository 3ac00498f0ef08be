// Sizes that differ from level to level.

struct Level {
    width: u32,
    height: u32,
    index: u32,
    // Whether luminance counts: the coarsest level.
    last: u32,
    // Of the coarser level; 0 without one.
    coarse_width: u32,
    coarse_height: u32,
    spare0: u32,
    spare1: u32,
}

struct Halving {
    fine_width: u32,
    fine_height: u32,
    width: u32,
    height: u32,
}

