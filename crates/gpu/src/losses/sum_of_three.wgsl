// Sums three values over the workgroup at once, each in the order of `sum_of_group`.
var<workgroup> triples: array<vec3<f32>, WG>;

fn sum_of_three(values: vec3<f32>, lane: u32) -> vec3<f32> {
    triples[lane] = values;
    workgroupBarrier();
    for (var reach = WG / 2u; reach > 0u; reach = reach >> 1u) {
        if (lane < reach) {
            triples[lane] = triples[lane] + triples[lane + reach];
        }
        workgroupBarrier();
    }
    let total = triples[0];
    workgroupBarrier();
    return total;
}
