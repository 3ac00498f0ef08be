// Lowers opacities to a ceiling and sets their moments to zero.
@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let i = group_of(wid, nwg) * WG + lid;
    if (i >= ceiling.count) { return; }
    geometry[3u * i].w = min(geometry[3u * i].w, ceiling.logit);
    geometry_first[3u * i].w = 0.0f;
    geometry_second[3u * i].w = 0.0f;
}
