// Adds up numbers that workgroups wrote side by side into `sums`. All threads of one workgroup call it.
fn total_of(first: u32, groups: u32, lane: u32) -> f32 {
    var own = 0.0;
    for (var group = lane; group < groups; group = group + WG) {
        own = own + sums[first + group];
    }
    return sum_of_group(own, lane);
}
