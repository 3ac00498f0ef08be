// One thread per row of four words: copies a row of a Gaussian of the new scene from its place in the old
// one. Copying words instead of floats keeps the bits unchanged.
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
    // The old scene may lie in several buffers; another dispatch copies the rows of the others.
    if (source < part.source || source - part.source >= part.sources) { return; }
    if (part.inherited == 0u && (origin & BORN) != 0u) {
        made[i] = vec4<u32>();
        return;
    }
    made[i] = old[(source - part.source) * part.width + i % part.width];
}
