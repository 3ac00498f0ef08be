// Constants that differ from level to level.

struct Level {
    width: u32,
    height: u32,
    index: u32,
    // 1 for the coarsest level, where luminance counts; else 0.
    last: u32,
    // Size of the coarser level; 0 if there is none.
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

