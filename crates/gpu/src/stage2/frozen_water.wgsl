// The frozen water of a view. First planes of its sections: the colour c_m, k of attenuation and of
// backscatter, and the signed logs of the colour.
const COLOR: u32 = 0u;
const ATTENUATION: u32 = 3u;
const BACKSCATTER: u32 = 6u;
const LOGS: u32 = 9u;

// The three values of a section at a pixel.
fn three_at(section: u32, pixel: u32) -> vec3<f32> {
    let first = section * field.pixels + pixel;
    return vec3<f32>(water[first], water[first + field.pixels], water[first + 2u * field.pixels]);
}
