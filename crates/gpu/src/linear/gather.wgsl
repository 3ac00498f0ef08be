// One thread per Gaussian: adds the records of its entries in their order, up to three channels.
@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let i = group_of(wid, nwg) * WG + lid;
    if (i >= constants.counts.x) { return; }
    let run = runs[i];
    var sum = vec3<f32>();
    for (var k = 0u; k < run.y; k++) { sum += records[run.x + k].xyz; }
    for (var c = 0u; c < part.x; c++) { sums[part.x * i + c] = sum[c]; }
}
