// One thread per parameter: its gradient, which adds the sums of the other kernels to the loss terms that
// read the field itself. The first index of a gradient that is not finite is stored.

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let at = group_of(wid, nwg) * WG + lid;
    if (at >= field.parameters) { return; }
    var g = of_field[at];
    if (at < field.output_bias) {
        g += gradient[at];
    } else if (at >= field.guide && at < field.affine) {
        g += totals[OF_GUIDE + at - field.guide];
        if (WATER) { g += totals[OF_WATER + WATER_GUIDE + at - field.guide]; }
    } else if (at >= field.affine && at < field.transport) {
        g += totals[OUTPUTS + at - field.affine];
        if (WATER) { g += totals[OF_WATER + WATER_AFFINE + at - field.affine]; }
    } else if (WATER && at >= field.transport) {
        let k = at - field.transport;
        let t = squash(state[at]);
        g += totals[OF_WATER + WATER_RATIOS + k] * grade[GRADE_RATIOS + k] * LOG_RATIO * (1.0f - t * t);
    }
    // The output bias has no effect on the loss, so the other kernels sum nothing for it.
    gradient[at] = g;
    if (is_bad(g)) { atomicMin(&status[BAD_GRADIENT], at); }
}
