// Writes a workgroup's three sums into three runs of `sums`.
fn write_sums(group: u32, lane: u32, a: f32, b: f32, c: f32) {
    let all = sum_of_three(vec3<f32>(a, b, c), lane);
    if (lane == 0u) {
        sums[group] = all.x;
        sums[view.groups + group] = all.y;
        sums[2u * view.groups + group] = all.z;
    }
}
