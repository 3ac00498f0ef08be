// Multiply-adds that read no memory. Each thread runs sixteen independent chains, so that no operation waits
// for the result of the one before it.
@compute @workgroup_size(WG)
fn main(
    @builtin(workgroup_id) wid: vec3<u32>,
    @builtin(num_workgroups) nwg: vec3<u32>,
    @builtin(local_invocation_index) lid: u32,
) {
    let i = group_of(wid, nwg) * WG + lid;
    let m = vec4<f32>(bitcast<f32>(rounds.y));
    let s = vec4<f32>(bitcast<f32>(rounds.z));
    var a = vec4<f32>(f32(i));
    var b = a + s;
    var c = b + s;
    var d = c + s;
    for (var k = 0u; k < rounds.x; k++) {
        a = fma(a, m, s);
        b = fma(b, m, s);
        c = fma(c, m, s);
        d = fma(d, m, s);
        a = fma(a, m, s);
        b = fma(b, m, s);
        c = fma(c, m, s);
        d = fma(d, m, s);
        a = fma(a, m, s);
        b = fma(b, m, s);
        c = fma(c, m, s);
        d = fma(d, m, s);
        a = fma(a, m, s);
        b = fma(b, m, s);
        c = fma(c, m, s);
        d = fma(d, m, s);
    }
    if (i < arrayLength(&sums)) { sums[i] = (a + b) + (c + d); }
}
