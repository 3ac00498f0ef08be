// One thread per four floats: copies them from one buffer to another.
@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let i = group_of(wid, nwg) * WG + lid;
    if (i < arrayLength(&origin)) { copied[i] = origin[i]; }
}
