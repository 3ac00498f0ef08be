// Adds up numbers that workgroups wrote side by side into `sums`. All threads of one workgroup call it.
fn total_of(first: u32, groups: u32, lane: u32) -> f32 {
    var own = 0.0;
    for (var group = lane; group < groups; group = group + WG) {
        own = own + sums[first + group];
    }
    return sum_of_group(own, lane);
}

// The same for three runs that begin at equal distances.
fn totals_of(first: u32, distance: u32, groups: u32, lane: u32) -> vec3<f32> {
    var own = vec3<f32>(0.0);
    for (var group = lane; group < groups; group = group + WG) {
        let at = first + group;
        own = own + vec3<f32>(sums[at], sums[at + distance], sums[at + 2u * distance]);
    }
    return sum_of_three(own, lane);
}
