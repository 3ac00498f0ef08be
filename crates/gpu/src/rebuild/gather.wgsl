// One thread per row of four words: those of a Gaussian of the new scene, from where they lie in the old one.
// Words, not floats, so that bits arrive as they were.
@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let i = group_of(wid, nwg) * WG + lid;
    if (i >= part.count * part.width) { return; }
    let origin = origins[part.first + i / part.width];
    let source = origin & ~BORN;
    // Another dispatch's, where the old scene lies in several buffers.
    if (source < part.source || source - part.source >= part.sources) { return; }
    if (part.inherited == 0u && (origin & BORN) != 0u) {
        made[i] = vec4<u32>();
        return;
    }
    made[i] = old[(source - part.source) * part.width + i % part.width];
}
