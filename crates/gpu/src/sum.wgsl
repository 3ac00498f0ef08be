// Sums a value over the workgroup in a fixed order: a tree over its threads. Their number is a power of two.
var<workgroup> cells: array<f32, WG>;

fn sum_of_group(value: f32, lane: u32) -> f32 {
    cells[lane] = value;
    workgroupBarrier();
    for (var reach = WG / 2u; reach > 0u; reach = reach >> 1u) {
        if (lane < reach) {
            cells[lane] = cells[lane] + cells[lane + reach];
        }
        workgroupBarrier();
    }
    let total = cells[0];
    workgroupBarrier();
    return total;
}
