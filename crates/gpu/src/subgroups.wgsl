// Each thread writes the width of its subgroup.
@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
    @builtin(subgroup_size) width: u32,
) {
    widths[group_of(wid, nwg) * WG + lid] = width;
}
