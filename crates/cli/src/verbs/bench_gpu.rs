//! `bench gpu`: everything there is to know of a graphics card, in one file.

use crate::App;
use crate::args::BenchGpuArgs;
use crate::error::{CliError, Done};

#[cfg(feature = "gpu")]
pub(crate) fn gpu(app: &App, args: &BenchGpuArgs) -> Done {
    use std::io::Write;

    use use3d_build::machine::seconds;
    use use3d_gpu::Gpu;
    use use3d_gpu::bench::{BenchPlan, bench};

    use crate::destination::{check_file, path_text, write_file};
    use crate::size::parse_size;

    check_file("--out", &args.out, args.replace.force, &["json"])?;
    let sizes = args.sizes.iter().map(|text| parse_size(text)).collect::<Result<Vec<_>, _>>()?;
    let gpu = Gpu::open(args.device.as_deref()).map_err(CliError::input)?;
    let say = |text: &str| {
        if !app.quiet {
            eprintln!("{text}");
        }
    };
    say(&format!("{} ({})", gpu.adapter().name, gpu.adapter().driver));
    let plan = BenchPlan {
        sizes,
        rounds: args.rounds,
        gaussians: args.gaussians.clone(),
        steps: args.steps as u64,
        // What every adapter binds, and more than its caches hold.
        copied: 128 << 20,
    };
    let record = bench(&gpu, &plan, say).map_err(CliError::failed)?;
    write_file("--out", &args.out, |writer| {
        serde_json::to_writer_pretty(&mut *writer, &record)?;
        writeln!(writer)
    })?;
    let wrong: Vec<String> = record
        .twins
        .iter()
        .filter(|twin| !twin.holds)
        .map(|twin| format!("{}: {}", twin.case, twin.what))
        .collect();
    for training in record.trainings.iter().filter(|training| training.refusal.is_none()) {
        let ([width, height], n, rate) = (training.size, training.gaussians, training.steps_per_second);
        say(&format!("{width} x {height}, {n} Gaussians: {rate:.1} steps a second"));
        let each = &training.backward_milliseconds;
        let each: Vec<String> =
            each.iter().map(|(variant, time)| format!("{variant} {time:.2} ms")).collect();
        if !each.is_empty() {
            say(&format!("  backward pass: {}", each.join(", ")));
        }
        let share = |name: &str| {
            training.roofline.get(name).map(|need| format!("{name} {:.0} %", 100.0 * need.share))
        };
        let shares: Vec<String> = ["forward", "backward", "update"].into_iter().filter_map(share).collect();
        if !shares.is_empty() {
            say(&format!("  of what the card does at best: {}", shares.join(", ")));
        }
    }
    say(&format!("written to {} in {}", path_text(&args.out), seconds(record.seconds)));
    if let Some(refusal) = record.check.refusal {
        return Err(CliError::Failed(refusal));
    }
    if !wrong.is_empty() {
        let what = wrong.join("; ");
        return Err(CliError::Failed(format!(
            "these differ from the processor's by more than they may: {what}"
        )));
    }
    if let Some(runs) = record.determinism.iter().find(|runs| !runs.same) {
        let variant = &runs.variant;
        return Err(CliError::Failed(format!("three runs of the same work gave different bits ({variant})")));
    }
    Ok(())
}

#[cfg(not(feature = "gpu"))]
pub(crate) fn gpu(_: &App, _: &BenchGpuArgs) -> Done {
    Err(CliError::Input(
        "this program was built without engines for graphics cards (cargo feature `gpu`)".into(),
    ))
}
