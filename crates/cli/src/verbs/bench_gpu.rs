//! `bench gpu`: all measurements of a graphics card, in one file.

use crate::App;
use crate::args::BenchGpuArgs;
use crate::error::{CliError, Done};

/// Measures a card, or reads the file of such a measurement, which needs no card.
pub(crate) fn gpu(app: &App, args: &BenchGpuArgs) -> Done {
    match &args.read {
        Some(file) => super::bench_read::read(file),
        None => measured(app, args),
    }
}

#[cfg(feature = "gpu")]
fn measured(app: &App, args: &BenchGpuArgs) -> Done {
    use std::io::Write;

    use use3d_gpu::Gpu;
    use use3d_gpu::bench::{BenchPlan, BenchRecord, bench};
    use use3d_workflow::machine::seconds;

    use crate::destination::{check_file, path_text, write_file};
    use crate::size::parse_size;

    if let Some(folder) = &args.kernels {
        return kernels(app, folder, args.replace.force);
    }
    let Some(out) = &args.out else {
        return Err(CliError::input("give the file to write: --out FILE.json"));
    };
    check_file("--out", out, args.replace.force, &["json"])?;
    let sizes = args.sizes.iter().map(|text| parse_size(text)).collect::<Result<Vec<_>, _>>()?;
    let gpu = Gpu::open(args.device.as_deref()).map_err(CliError::input)?;
    let say = |text: &str| remark!(app, "{text}");
    remark!(app, "{} ({})", gpu.adapter.name, gpu.adapter.driver);
    remark!(app, "kernels: {}", gpu.kernels());
    for refusal in gpu.refused_before.iter() {
        remark!(app, "skipped: {refusal}");
    }
    // A card needs minutes for all of it; software needs as long for a few steps.
    let (steps, long) = match (args.steps, gpu.adapter.is_software()) {
        (Some(steps), _) => (steps as u64, None),
        (None, false) => (200, Some(1000)),
        (None, true) => (10, None),
    };
    let plan = BenchPlan {
        sizes,
        rounds: args.rounds,
        gaussians: args.gaussians.clone(),
        steps,
        long,
        // A size that every adapter can bind, and larger than its caches.
        copied: 128 << 20,
        seconds: Some(60.0 * args.minutes as f64),
    };
    let write = |record: &BenchRecord| {
        write_file("--out", out, |writer| {
            serde_json::to_writer_pretty(&mut *writer, record)?;
            writeln!(writer)
        })
    };
    // Each record so far is kept, whatever happens later; only the last write must succeed.
    let mut written = Ok(());
    let stop = || app.stop.load(std::sync::atomic::Ordering::Relaxed);
    let record = bench(&gpu, &plan, &stop, say, |record| written = write(record));
    written?;
    if stop() {
        return Err(CliError::Interrupted);
    }
    let wrong = record.twins.iter().filter(|twin| !twin.holds);
    let wrong: Vec<String> = wrong.map(|twin| format!("{}: {}", twin.case, twin.what)).collect();
    for training in &record.trainings {
        let ([width, height], n, rate) = (training.size, training.gaussians, training.steps_per_second);
        if training.steps > 0 {
            let idle = training.idle_share.map(|idle| format!(", {:.0} % of the time idle", 100.0 * idle));
            let idle = idle.unwrap_or_default();
            remark!(app, "{width} x {height}, {n} Gaussians: {rate:.1} steps a second{idle}");
        }
        if let Some(time) = training.refinement_milliseconds {
            remark!(app, "  a refinement: {time:.1} ms");
        }
        if let Some(enhancement) = &training.enhancement {
            remark!(app, "  stage 2: {:.1} steps a second", enhancement.steps_per_second);
        }
        if let Some(refusal) = &training.refusal {
            remark!(app, "{width} x {height}, {n} Gaussians: {refusal}");
        }
        let each = &training.backward_milliseconds;
        let each: Vec<String> =
            each.iter().map(|(variant, time)| format!("{variant} {time:.2} ms")).collect();
        if !each.is_empty() {
            remark!(app, "  backward pass: {}", each.join(", "));
        }
        let share = |name: &str| {
            training.roofline.get(name).map(|need| format!("{name} {:.0} %", 100.0 * need.share))
        };
        let shares: Vec<String> = ["forward", "backward", "update"].into_iter().filter_map(share).collect();
        if !shares.is_empty() {
            remark!(app, "  of what the card does at best: {}", shares.join(", "));
        }
    }
    if !record.left_out.is_empty() {
        let left = record.left_out.join("; ");
        remark!(app, "left out after {} minutes (--minutes): {left}", args.minutes);
    }
    remark!(app, "written to {} in {}", path_text(out), seconds(record.seconds));
    if let Some(refusal) = record.check.and_then(|check| check.refusal) {
        return Err(CliError::Failed(refusal));
    }
    if !record.failed.is_empty() {
        let each: Vec<String> =
            record.failed.iter().map(|failed| format!("{}: {}", failed.section, failed.why)).collect();
        return Err(CliError::Failed(format!("not everything could be measured: {}", each.join("; "))));
    }
    if !wrong.is_empty() {
        let what = "these results differ from the processor's by more than the tolerance";
        return Err(CliError::Failed(format!("{what}: {}", wrong.join("; "))));
    }
    if let Some(runs) = record.determinism.iter().find(|runs| !runs.same) {
        let variant = &runs.variant;
        return Err(CliError::Failed(format!("three runs of the same work gave different bits ({variant})")));
    }
    Ok(())
}

/// Writes the text of every kernel into a folder. A file's name begins with the kernel's.
#[cfg(feature = "gpu")]
fn kernels(app: &App, folder: &std::path::Path, force: bool) -> Done {
    use crate::destination::path_text;

    if !force && folder.read_dir().is_ok_and(|mut files| files.next().is_some()) {
        let what = "the folder has files; pass --force to write into it, or choose another folder";
        return Err(CliError::Input(format!("--kernels {}: {what}", path_text(folder))));
    }

    let failed = |error: std::io::Error| {
        CliError::Failed(format!("--kernels: cannot write into {}: {error}", path_text(folder)))
    };
    std::fs::create_dir_all(folder).map_err(failed)?;
    let texts = use3d_gpu::kernel_texts();
    for (at, (name, text)) in texts.iter().enumerate() {
        let plain = name.replace(|c: char| !c.is_ascii_alphanumeric(), "-").replace("--", "-");
        std::fs::write(folder.join(format!("{plain}-{at:03}.wgsl")), text).map_err(failed)?;
    }
    if !app.quiet {
        println!("{} texts written to {}", texts.len(), path_text(folder));
    }
    Ok(())
}

#[cfg(not(feature = "gpu"))]
fn measured(_: &App, _: &BenchGpuArgs) -> Done {
    Err(CliError::input(crate::error::NO_GPU))
}
