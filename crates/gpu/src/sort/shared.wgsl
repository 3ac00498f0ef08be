const DIGITS: u32 = 256u;

struct Pass {
    // First bit of the digit; number of items; number of blocks that there is room for; 1 if the number of
    // items is read from `counts` instead.
    shift: u32,
    items: u32,
    blocks: u32,
    counted: u32,
}

fn item_count() -> u32 {
    if (order.counted != 0u) { return min(counts[0], order.items); }
    return order.items;
}

fn digit_of(key: u32) -> u32 { return (key >> order.shift) & (DIGITS - 1u); }
