// One thread per hidden unit: the gradients with respect to its weights, summed over a block of lookups, 64
// at a time. No sum leaves its thread.
const AT_ONCE: u32 = 64u;

var<workgroup> tile_codes: array<f32, AT_ONCE * RANK>;
var<workgroup> tile_gains: array<vec4<f32>, AT_ONCE>;
var<workgroup> tile_biases: array<vec4<f32>, AT_ONCE>;

@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let group = group_of(wid, nwg);
    let block = group / field.unit_groups;
    let unit = (group % field.unit_groups) * WG + lid;
    if (block >= field.blocks) { return; }
    let mine = unit < field.width;
    var bias = 0.0f;
    var weights: array<f32, RANK>;
    var gains = vec3<f32>();
    var biases = vec3<f32>();
    if (mine) {
        bias = state[field.hidden_bias + unit];
        for (var r = 0u; r < RANK; r++) { weights[r] = state[field.hidden_weight + unit * RANK + r]; }
        gains = gain_weights(unit);
        biases = bias_weights(unit);
    }
    var by_weights: array<f32, RANK>;
    var by_bias = 0.0f;
    var by_gains = vec3<f32>();
    var by_biases = vec3<f32>();
    let end = min((block + 1u) * field.per_block, field.lookups);
    for (var first = block * field.per_block; first < end; first += AT_ONCE) {
        workgroupBarrier();
        let i = first + lid;
        if (i < end) {
            for (var r = 0u; r < RANK; r++) { tile_codes[lid * RANK + r] = codes[RANK * i + r]; }
            let at = OUTPUTS * i;
            tile_gains[lid] = vec4<f32>(slopes[at], slopes[at + 1u], slopes[at + 2u], 0.0f);
            tile_biases[lid] = vec4<f32>(slopes[at + 3u], slopes[at + 4u], slopes[at + 5u], 0.0f);
        }
        workgroupBarrier();
        var own_weights: array<f32, RANK>;
        var own_bias = 0.0f;
        var own_gains = vec3<f32>();
        var own_biases = vec3<f32>();
        let count = min(AT_ONCE, end - first);
        for (var k = 0u; k < count; k++) {
            var pre = bias;
            for (var r = 0u; r < RANK; r++) { pre = fma(tile_codes[k * RANK + r], weights[r], pre); }
            let s = logistic(pre);
            let hidden = pre * s;
            let by_hidden = dot(tile_gains[k].xyz, gains) + dot(tile_biases[k].xyz, biases);
            let by_pre = by_hidden * s * fma(pre, 1.0f - s, 1.0f);
            for (var r = 0u; r < RANK; r++) { own_weights[r] = fma(by_pre, tile_codes[k * RANK + r], own_weights[r]); }
            own_bias += by_pre;
            own_gains = fma(vec3<f32>(hidden), tile_gains[k].xyz, own_gains);
            own_biases = fma(vec3<f32>(hidden), tile_biases[k].xyz, own_biases);
        }
        for (var r = 0u; r < RANK; r++) { by_weights[r] += own_weights[r]; }
        by_bias += own_bias;
        by_gains += own_gains;
        by_biases += own_biases;
    }
    if (!mine) { return; }
    let to = block * field.output_bias;
    for (var r = 0u; r < RANK; r++) { partial[to + field.hidden_weight + unit * RANK + r] = by_weights[r]; }
    partial[to + field.hidden_bias + unit] = by_bias;
    for (var o = 0u; o < 3u; o++) {
        partial[to + field.output_weight + o * field.width + unit] = by_gains[o];
        partial[to + field.output_weight + (3u + o) * field.width + unit] = by_biases[o];
    }
}
