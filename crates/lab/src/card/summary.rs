//! The result of a benchmark in lines, and what is wrong with the card.

use std::io;
use std::path::Path;

use super::read::pace;
use super::records::{BenchRecord, TrainingRecord};

/// The lines of one training.
fn of_training(training: &TrainingRecord) -> Vec<String> {
    let ([width, height], n, rate) = (training.size, training.gaussians, training.steps_per_second);
    let title = format!("{width} x {height}, {n} Gaussians");
    let mut lines = Vec::new();
    if training.steps > 0 {
        lines.push(pace(&title, rate, training.idle_share));
    }
    if let Some(time) = training.refinement_milliseconds {
        lines.push(format!("  a refinement: {time:.1} ms"));
    }
    if let Some(enhancement) = &training.enhancement {
        lines.push(format!("  stage 2: {:.1} steps a second", enhancement.steps_per_second));
    }
    if let Some(refusal) = &training.refusal {
        lines.push(format!("{title}: {refusal}"));
    }
    let each = &training.backward_milliseconds;
    let each: Vec<String> = each.iter().map(|(variant, time)| format!("{variant} {time:.2} ms")).collect();
    if !each.is_empty() {
        lines.push(format!("  backward pass: {}", each.join(", ")));
    }
    let share =
        |name: &str| training.roofline.get(name).map(|need| format!("{name} {:.0} %", 100.0 * need.share));
    let shares: Vec<String> = ["forward", "backward", "update"].into_iter().filter_map(share).collect();
    if !shares.is_empty() {
        lines.push(format!("  of what the card does at best: {}", shares.join(", ")));
    }
    lines
}

/// The lines of a finished benchmark: the trainings, and the parts for which `minutes` were too short.
pub fn lines(record: &BenchRecord, minutes: usize) -> Vec<String> {
    let mut lines: Vec<String> = record.trainings.iter().flat_map(of_training).collect();
    if !record.left_out.is_empty() {
        let left = record.left_out.join("; ");
        lines.push(format!("left out after {minutes} minutes (--minutes): {left}"));
    }
    lines
}

/// The first thing that is wrong: a refused card, a failed part, wrong numbers, or bits that differ between
/// runs.
pub fn fault(record: &BenchRecord) -> Option<String> {
    if let Some(refusal) = record.check.as_ref().and_then(|check| check.refusal.clone()) {
        return Some(refusal);
    }
    if !record.failed.is_empty() {
        let each: Vec<String> =
            record.failed.iter().map(|failed| format!("{}: {}", failed.section, failed.why)).collect();
        return Some(format!("not everything could be measured: {}", each.join("; ")));
    }
    let wrong = record.twins.iter().filter(|twin| !twin.holds);
    let wrong: Vec<String> = wrong.map(|twin| format!("{}: {}", twin.case, twin.what)).collect();
    if !wrong.is_empty() {
        let what = "these results differ from the processor's by more than the tolerance";
        return Some(format!("{what}: {}", wrong.join("; ")));
    }
    let runs = record.determinism.iter().find(|runs| !runs.same)?;
    Some(format!("three runs of the same work gave different bits ({})", runs.variant))
}

/// Writes the text of every kernel into a folder, and returns their number. A file's name begins with the
/// kernel's.
///
/// # Errors
/// Fails if the folder cannot be made or written.
pub fn write_kernels(folder: &Path) -> io::Result<usize> {
    std::fs::create_dir_all(folder)?;
    let texts = use3d_gpu::kernel_texts();
    for (at, (name, text)) in texts.iter().enumerate() {
        let plain = name.replace(|c: char| !c.is_ascii_alphanumeric(), "-").replace("--", "-");
        std::fs::write(folder.join(format!("{plain}-{at:03}.wgsl")), text)?;
    }
    Ok(texts.len())
}
