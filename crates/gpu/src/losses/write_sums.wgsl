// Writes a workgroup's three sums into three runs of `sums`.
fn write_sums(group: u32, lane: u32, a: f32, b: f32, c: f32) {
    let first = sum_of_group(a, lane);
    let second = sum_of_group(b, lane);
    let third = sum_of_group(c, lane);
    if (lane == 0u) {
        sums[group] = first;
        sums[view.groups + group] = second;
        sums[2u * view.groups + group] = third;
    }
}
