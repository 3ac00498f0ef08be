//! Numbers as printed in the 3D-USE paper, for the rows shown next to ours on the same scenes.
//!
//! Source: *3D-USE: From Image-Level to Scene-Level Underwater Enhancement*, main tables and supplementary.
//! They are the authors' measurements of all methods; nothing here was measured by this program.

/// The source that the cells of published rows name.
pub const SOURCE: &str = "published: 3D-USE paper";

/// A method's numbers for one data set or scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Published {
    /// The method.
    pub method: &'static str,
    /// The data set or scene, by its name in the paper's pipelines.
    pub group: &'static str,
    /// The values, in the order of the table's quantities.
    pub values: [f64; 3],
}

const fn row(method: &'static str, group: &'static str, values: [f64; 3]) -> Published {
    Published { method, group, values }
}

/// Held-out reconstruction: PSNR, SSIM, LPIPS.
pub const RECONSTRUCTION: &[Published] = &[
    row("WaterSplatting", "SeaThru-4", [29.340, 0.919, 0.129]),
    row("WaterSplatting", "DRUVA-20", [27.007, 0.864, 0.357]),
    row("WaterSplatting", "D3", [27.380, 0.776, 0.253]),
    row("WaterSplatting", "D5", [29.113, 0.817, 0.313]),
    row("SeaSplat", "SeaThru-4", [27.146, 0.878, 0.184]),
    row("SeaSplat", "DRUVA-20", [22.866, 0.828, 0.388]),
    row("SeaSplat", "D3", [27.885, 0.785, 0.282]),
    row("SeaSplat", "D5", [27.113, 0.806, 0.382]),
    row("MarineSTD-GS", "SeaThru-4", [30.034, 0.901, 0.160]),
    row("MarineSTD-GS", "DRUVA-20", [26.472, 0.856, 0.364]),
    row("MarineSTD-GS", "D3", [29.510, 0.781, 0.316]),
    row("MarineSTD-GS", "D5", [30.237, 0.818, 0.329]),
    row("Plenodium", "SeaThru-4", [30.331, 0.922, 0.125]),
    row("Plenodium", "DRUVA-20", [27.413, 0.866, 0.335]),
    row("Plenodium", "D3", [28.686, 0.803, 0.218]),
    row("Plenodium", "D5", [29.088, 0.817, 0.314]),
    row("3D-UIR", "SeaThru-4", [28.260, 0.889, 0.179]),
    row("3D-UIR", "DRUVA-20", [25.432, 0.820, 0.354]),
    row("3D-UIR", "D3", [28.098, 0.830, 0.283]),
    row("3D-UIR", "D5", [28.973, 0.823, 0.324]),
    row("3D-USE", "SeaThru-4", [30.369, 0.924, 0.124]),
    row("3D-USE", "DRUVA-20", [27.495, 0.867, 0.352]),
    row("3D-USE", "D3", [29.759, 0.858, 0.183]),
    row("3D-USE", "D5", [31.400, 0.908, 0.235]),
];

/// Held-out reconstruction on the four SeaThru-NeRF scenes: PSNR, SSIM, LPIPS.
pub const RECONSTRUCTION_SCENES: &[Published] = &[
    row("WaterSplatting", "IUI3-RedSea", [29.330, 0.891, 0.206]),
    row("WaterSplatting", "Curasao", [31.701, 0.951, 0.114]),
    row("WaterSplatting", "JapaneseGradens-RedSea", [24.732, 0.892, 0.120]),
    row("WaterSplatting", "Panama", [31.598, 0.941, 0.076]),
    row("SeaSplat", "IUI3-RedSea", [27.552, 0.853, 0.209]),
    row("SeaSplat", "Curasao", [29.323, 0.892, 0.191]),
    row("SeaSplat", "JapaneseGradens-RedSea", [22.777, 0.867, 0.190]),
    row("SeaSplat", "Panama", [28.932, 0.899, 0.146]),
    row("MarineSTD-GS", "IUI3-RedSea", [30.433, 0.890, 0.202]),
    row("MarineSTD-GS", "Curasao", [33.688, 0.939, 0.143]),
    row("MarineSTD-GS", "JapaneseGradens-RedSea", [26.337, 0.881, 0.152]),
    row("MarineSTD-GS", "Panama", [29.678, 0.893, 0.145]),
    row("Plenodium", "IUI3-RedSea", [30.179, 0.892, 0.205]),
    row("Plenodium", "Curasao", [33.861, 0.955, 0.105]),
    row("Plenodium", "JapaneseGradens-RedSea", [24.872, 0.895, 0.115]),
    row("Plenodium", "Panama", [32.413, 0.945, 0.075]),
    row("3D-UIR", "IUI3-RedSea", [28.640, 0.868, 0.233]),
    row("3D-UIR", "Curasao", [30.722, 0.896, 0.178]),
    row("3D-UIR", "JapaneseGradens-RedSea", [23.592, 0.884, 0.162]),
    row("3D-UIR", "Panama", [30.085, 0.910, 0.142]),
    row("3D-USE", "IUI3-RedSea", [30.215, 0.896, 0.206]),
    row("3D-USE", "Curasao", [33.965, 0.957, 0.104]),
    row("3D-USE", "JapaneseGradens-RedSea", [24.957, 0.896, 0.116]),
    row("3D-USE", "Panama", [32.337, 0.947, 0.071]),
];

/// Enhanced held-out views: UCIQE, URanker, MUSIQ.
pub const ENHANCEMENT: &[Published] = &[
    row("WaterSplatting", "SeaThru-4", [0.508, 1.361, 58.529]),
    row("WaterSplatting", "DRUVA-20", [0.385, -0.856, 33.193]),
    row("WaterSplatting", "D3", [0.470, 0.541, 58.833]),
    row("WaterSplatting", "D5", [0.499, 0.690, 55.568]),
    row("SeaSplat", "SeaThru-4", [0.588, 1.555, 54.470]),
    row("SeaSplat", "DRUVA-20", [0.518, -0.186, 28.252]),
    row("SeaSplat", "D3", [0.504, 1.007, 58.251]),
    row("SeaSplat", "D5", [0.442, -0.895, 40.648]),
    row("Plenodium", "SeaThru-4", [0.503, 1.058, 58.370]),
    row("Plenodium", "DRUVA-20", [0.395, -0.792, 34.786]),
    row("Plenodium", "D3", [0.483, 0.705, 60.158]),
    row("Plenodium", "D5", [0.443, 0.033, 52.456]),
    row("MarineSTD-GS", "SeaThru-4", [0.522, 0.918, 55.890]),
    row("MarineSTD-GS", "DRUVA-20", [0.447, -0.567, 39.070]),
    row("MarineSTD-GS", "D3", [0.443, 0.416, 56.246]),
    row("MarineSTD-GS", "D5", [0.413, -0.117, 54.424]),
    row("3D-UIR", "SeaThru-4", [0.609, 1.658, 54.540]),
    row("3D-UIR", "DRUVA-20", [0.537, 0.174, 32.752]),
    row("3D-UIR", "D3", [0.519, 1.356, 59.351]),
    row("3D-UIR", "D5", [0.468, 0.137, 51.991]),
    row("3D-USE", "SeaThru-4", [0.609, 1.679, 59.881]),
    row("3D-USE", "DRUVA-20", [0.575, 0.456, 36.598]),
    row("3D-USE", "D3", [0.543, 2.034, 62.993]),
    row("3D-USE", "D5", [0.513, 1.027, 58.324]),
];

/// Enhanced held-out views of the four SeaThru-NeRF scenes: UCIQE, URanker, MUSIQ.
pub const ENHANCEMENT_SCENES: &[Published] = &[
    row("WaterSplatting", "IUI3-RedSea", [0.509, 1.045, 57.549]),
    row("WaterSplatting", "Curasao", [0.547, 1.924, 66.755]),
    row("WaterSplatting", "JapaneseGradens-RedSea", [0.497, 1.555, 56.981]),
    row("WaterSplatting", "Panama", [0.480, 0.920, 52.831]),
    row("SeaSplat", "IUI3-RedSea", [0.579, 1.503, 51.292]),
    row("SeaSplat", "Curasao", [0.586, 1.247, 60.171]),
    row("SeaSplat", "JapaneseGradens-RedSea", [0.601, 1.922, 53.844]),
    row("SeaSplat", "Panama", [0.586, 1.549, 52.572]),
    row("Plenodium", "IUI3-RedSea", [0.511, 0.826, 60.681]),
    row("Plenodium", "Curasao", [0.499, 0.831, 61.631]),
    row("Plenodium", "JapaneseGradens-RedSea", [0.507, 1.489, 57.784]),
    row("Plenodium", "Panama", [0.496, 1.086, 53.384]),
    row("MarineSTD-GS", "IUI3-RedSea", [0.546, 1.161, 58.370]),
    row("MarineSTD-GS", "Curasao", [0.477, 0.087, 58.286]),
    row("MarineSTD-GS", "JapaneseGradens-RedSea", [0.543, 1.329, 55.681]),
    row("MarineSTD-GS", "Panama", [0.520, 1.094, 51.222]),
    row("3D-UIR", "IUI3-RedSea", [0.597, 1.558, 49.705]),
    row("3D-UIR", "Curasao", [0.593, 1.258, 62.398]),
    row("3D-UIR", "JapaneseGradens-RedSea", [0.621, 1.925, 52.173]),
    row("3D-UIR", "Panama", [0.623, 1.890, 53.886]),
    row("3D-USE", "IUI3-RedSea", [0.629, 1.733, 61.373]),
    row("3D-USE", "Curasao", [0.564, 1.000, 64.469]),
    row("3D-USE", "JapaneseGradens-RedSea", [0.632, 2.112, 59.718]),
    row("3D-USE", "Panama", [0.608, 1.873, 53.964]),
];

/// Warped LPIPS of enhanced views: method, then SeaThru-4, DRUVA-20, D3, D5.
pub const CONSISTENCY: &[(&str, [f64; 4])] = &[
    ("WaterSplatting", [0.1565, 0.1699, 0.2210, 0.2453]),
    ("SeaSplat", [0.1530, 0.2189, 0.2131, 0.2341]),
    ("Plenodium", [0.1446, 0.1537, 0.2124, 0.2398]),
    ("MarineSTD-GS", [0.1447, 0.2309, 0.2108, 0.2169]),
    ("3D-UIR", [0.1558, 0.2174, 0.2376, 0.2017]),
    ("3D-USE", [0.1402, 0.1406, 0.2376, 0.2249]),
];

/// Warped LPIPS of enhanced views, the mean over all 26 scenes, as the enhancement table prints it.
pub const CONSISTENCY_ALL: &[(&str, f64)] = &[
    ("WaterSplatting", 0.173),
    ("SeaSplat", 0.209),
    ("Plenodium", 0.158),
    ("MarineSTD-GS", 0.216),
    ("3D-UIR", 0.208),
    ("3D-USE", 0.147),
];

/// The order of the groups in [`CONSISTENCY`].
pub const GROUPS: [&str; 4] = ["SeaThru-4", "DRUVA-20", "D3", "D5"];

/// Number of scenes in the paper.
pub const SCENES: usize = 26;

/// The group and image size of a scene of the paper, by its name in pipelines.
pub fn scene(name: &str) -> Option<(&'static str, (usize, usize))> {
    const PHOTOGRAPH: (usize, usize) = (1400, 933);
    match name {
        "IUI3-RedSea" | "Curasao" | "JapaneseGradens-RedSea" | "Panama" => Some(("SeaThru-4", PHOTOGRAPH)),
        "D3" => Some(("D3", PHOTOGRAPH)),
        "D5" => Some(("D5", PHOTOGRAPH)),
        _ => {
            let number = name.strip_prefix('A')?.parse::<usize>().ok()?;
            let known = (1..=20).contains(&number) && name == format!("A{number}");
            known.then_some(("DRUVA-20", (1920, 1080)))
        }
    }
}

/// Number of scenes in a group of the paper.
pub fn scenes_of(group: &str) -> usize {
    match group {
        "SeaThru-4" => 4,
        "DRUVA-20" => 20,
        _ => 1,
    }
}

/// Frames per second at 1400×933 on the authors' GPU.
pub const FPS: &[(&str, f64)] = &[
    ("WaterSplatting", 99.78),
    ("SeaSplat", 100.77),
    ("MarineSTD-GS", 41.13),
    ("Plenodium", 91.60),
    ("3D-UIR", 42.74),
    ("3D-USE", 105.36),
];

/// Stage-1 ablation on SeaThru-4: PSNR, SSIM, LPIPS.
pub const ABLATION_STAGE1: &[Published] = &[
    row("Vanilla 3DGS", "SeaThru-4", [27.411, 0.889, 0.178]),
    row("MLP medium", "SeaThru-4", [29.340, 0.919, 0.129]),
    row("MediumRBF w/o depth", "SeaThru-4", [30.212, 0.922, 0.125]),
    row("Full model", "SeaThru-4", [30.369, 0.924, 0.124]),
];

/// Stage-2 ablation on SeaThru-4: UCIQE, URanker, MUSIQ.
pub const ABLATION_STAGE2: &[Published] = &[
    row("Stage 1", "SeaThru-4", [0.518, 0.784, 57.500]),
    row("Local only", "SeaThru-4", [0.562, 1.394, 57.831]),
    row("Global only", "SeaThru-4", [0.614, 1.491, 58.402]),
    row("Full model", "SeaThru-4", [0.609, 1.679, 59.881]),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mean_over_all_scenes_is_that_of_the_groups() {
        for (method, groups) in CONSISTENCY {
            let sum: f64 = GROUPS.iter().zip(groups).map(|(g, v)| scenes_of(g) as f64 * v).sum();
            let (_, all) = CONSISTENCY_ALL.iter().find(|(m, _)| m == method).expect("the same methods");
            assert!((sum / SCENES as f64 - all).abs() < 1e-3, "{method}: {} {all}", sum / SCENES as f64);
        }
        assert_eq!(GROUPS.iter().map(|g| scenes_of(g)).sum::<usize>(), SCENES);
        assert_eq!(scene("A20"), Some(("DRUVA-20", (1920, 1080))));
        assert!([scene("A21"), scene("A01"), scene("A"), scene("reef")].iter().all(Option::is_none));
    }

    /// The group rows are the means of the scene rows, as the paper says, within its rounding.
    #[test]
    fn group_rows_are_means_of_scene_rows() {
        for (scenes, groups, tolerance) in
            [(RECONSTRUCTION_SCENES, RECONSTRUCTION, 1.1e-3), (ENHANCEMENT_SCENES, ENHANCEMENT, 1.1e-3)]
        {
            for group in groups.iter().filter(|g| g.group == "SeaThru-4") {
                for q in 0..3 {
                    let values: Vec<f64> =
                        scenes.iter().filter(|s| s.method == group.method).map(|s| s.values[q]).collect();
                    assert_eq!(values.len(), 4);
                    let mean = values.iter().sum::<f64>() / 4.0;
                    assert!((mean - group.values[q]).abs() < tolerance, "{} {q}: {mean}", group.method);
                }
            }
        }
    }
}
