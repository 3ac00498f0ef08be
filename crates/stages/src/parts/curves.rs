//! The curves of stage 1's training, from its log.

use serde_json::Value;
use use3d_chart::{Plot, Series};

/// Loss, PSNR and number of Gaussians over the steps, each with a sentence for its readers.
pub(crate) fn stage_1(log: &str) -> [(Plot, &'static str); 3] {
    let entries: Vec<Value> = log.lines().filter_map(|line| serde_json::from_str(line).ok()).collect();
    let curve = |name: &str, color: &'static str, label: &str, evaluated: bool| {
        let event = if evaluated { "evaluation" } else { "steps" };
        let points = entries.iter().filter(|e| e["event"] == event);
        let points = points.filter_map(|e| Some((e["step"].as_f64()?, e[name].as_f64()?))).collect();
        Series { dots: evaluated, ..Series::line(label, color, points) }
    };
    let plot = |title: &str, log_y: bool, series: Vec<Series>| Plot {
        title: title.into(),
        x_label: "step".into(),
        log_y,
        series,
    };
    let psnr = vec![
        curve("psnr", "#0b7285", "training views", false),
        curve("psnr", "#e8590c", "held-out views", true),
    ];
    [
        (
            plot("Stage 1: loss", true, vec![curve("loss", "#0b7285", "", false)]),
            "The difference between the photographs and pictures of the same views. It should fall and level out.",
        ),
        (
            plot("Stage 1: PSNR, dB", false, psnr),
            "Above 30 dB differences are hard to see. Held-out views far below the training views mean too few or \
             too similar photographs.",
        ),
        (
            plot("Stage 1: Gaussians", false, vec![curve("gaussians", "#845ef7", "", false)]),
            "The number of Gaussians in the scene. It grows as long as detail is added.",
        ),
    ]
}
