//! `bench gpu`: all measurements of a graphics card, in one file.

use crate::App;
use crate::args::BenchGpuArgs;
use crate::error::{Done, WorkError};

/// Measures a card, or reads the file of such a measurement, which needs no card.
pub(crate) fn gpu(app: &App, args: &BenchGpuArgs) -> Done {
    let Some(file) = &args.read else { return measured(app, args) };
    use3d_lab::card::read::read(file)?.iter().for_each(|line| println!("{line}"));
    Ok(())
}

#[cfg(feature = "gpu")]
fn measured(app: &App, args: &BenchGpuArgs) -> Done {
    use std::io::Write;

    use use3d_gpu::Gpu;
    use use3d_lab::card::measured::{BenchPlan, bench};
    use use3d_lab::card::summary::{fault, lines};
    use use3d_workflow::machine::seconds;

    use crate::size::parse_size;
    use use3d_pipeline::destination::{check_file, path_text, write_file};

    if let Some(folder) = &args.kernels {
        return kernels(app, folder, args.replace.force);
    }
    let Some(out) = &args.out else {
        return Err(WorkError::input("give the file to write: --out FILE.json"));
    };
    check_file("--out", out, args.replace.force, &["json"])?;
    let sizes = args.sizes.iter().map(|text| parse_size(text)).collect::<Result<Vec<_>, _>>()?;
    let gpu = Gpu::open(args.device.as_deref()).map_err(WorkError::input)?;
    remark!(app, "{} ({})", gpu.adapter.name, gpu.adapter.driver);
    remark!(app, "kernels: {}", gpu.kernels());
    for refusal in gpu.refused_before.iter() {
        remark!(app, "skipped: {refusal}");
    }
    let steps = args.steps.map(|steps| steps as u64);
    let plan = BenchPlan::new(&gpu, (sizes, args.gaussians.clone()), args.rounds, steps, args.minutes);
    // Each record so far is kept, whatever happens later; only the last write must succeed.
    let mut written = Ok(());
    let stop = || app.host.stops();
    let say = |text: &str| remark!(app, "{text}");
    let record = bench(&gpu, &plan, &stop, say, |record| {
        written = write_file("--out", out, |writer| {
            serde_json::to_writer_pretty(&mut *writer, record)?;
            writeln!(writer)
        });
    });
    written?;
    if stop() {
        return Err(WorkError::Interrupted);
    }
    for line in lines(&record, args.minutes) {
        remark!(app, "{line}");
    }
    remark!(app, "written to {} in {}", path_text(out), seconds(record.seconds));
    fault(&record).map_or(Ok(()), |fault| Err(WorkError::Failed(fault)))
}

/// Writes the text of every kernel into a folder.
#[cfg(feature = "gpu")]
fn kernels(app: &App, folder: &std::path::Path, force: bool) -> Done {
    use use3d_pipeline::destination::path_text;

    if !force && folder.read_dir().is_ok_and(|mut files| files.next().is_some()) {
        let what = "the folder has files; pass --force to write into it, or choose another folder";
        return Err(WorkError::Input(format!("--kernels {}: {what}", path_text(folder))));
    }
    let texts = use3d_lab::card::summary::write_kernels(folder).map_err(|error| {
        WorkError::Failed(format!("--kernels: cannot write into {}: {error}", path_text(folder)))
    })?;
    if !app.quiet {
        println!("{texts} texts written to {}", path_text(folder));
    }
    Ok(())
}

#[cfg(not(feature = "gpu"))]
fn measured(_: &App, _: &BenchGpuArgs) -> Done {
    Err(WorkError::input(crate::error::NO_GPU))
}
