// Sums rows over the workgroup in a fixed order: a tree over its threads. Their number is a power of two.
var<workgroup> row_cells: array<vec4<f32>, WG>;

fn sum_of_rows(value: vec4<f32>, lane: u32) -> vec4<f32> {
    row_cells[lane] = value;
    workgroupBarrier();
    for (var reach = WG / 2u; reach > 0u; reach = reach >> 1u) {
        if (lane < reach) { row_cells[lane] += row_cells[lane + reach]; }
        workgroupBarrier();
    }
    let total = row_cells[0];
    workgroupBarrier();
    return total;
}
