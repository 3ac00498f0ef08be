// One workgroup per value: the sum of its partial sums, in a fixed order. The constant OF chooses the sums: 0
// parameters, 1 colours, 2 water, 3 guide.
@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let value = group_of(wid, nwg);
    var groups = field.blocks;
    var width = field.output_bias;
    if (OF == 1u) { groups = (field.listed + 63u) / 64u; width = 18u; }
    if (OF == 2u) { groups = field.water_groups; width = WATER_SUMS; }
    if (OF == 3u) { groups = field.lookup_groups; width = 4u; }
    var own = 0.0f;
    for (var group = lid; group < groups && value < width; group += WG) { own += partial[width * group + value]; }
    let sum = sum_of_group(own, lid);
    if (lid == 0u && value < width) { totals[FIRST + value] = sum; }
}
