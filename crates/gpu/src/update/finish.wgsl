// The last kernel of a step. A value that was not finite in this step stops all following steps. How the step
// ended is stored in `ends`.
@compute @workgroup_size(WG)
fn main(@builtin(local_invocation_index) lid: u32) {
    if (lid != 0u) { return; }
    if (counts[BAD] != 0u && counts[STOP] == 0u) {
        counts[STOP] = NON_FINITE;
        counts[STOP_STEP] = constants.counts.w;
    }
    ends[constants.flags.w] = vec4<u32>(counts[STOP], counts[STOP_STEP], counts[BAD], counts[MOST]);
}
