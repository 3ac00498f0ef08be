// The last kernel of a step: what went wrong in it stops the steps that follow, and how it ended is noted.
@compute @workgroup_size(WG)
fn main(@builtin(local_invocation_index) lid: u32) {
    if (lid != 0u) { return; }
    if (counts[BAD] != 0u && counts[STOP] == 0u) {
        counts[STOP] = NON_FINITE;
        counts[STOP_STEP] = constants.counts.w;
    }
    ends[constants.flags.w] = vec4<u32>(counts[STOP], counts[STOP_STEP], counts[BAD], counts[MOST]);
}
