//! Reports the quality of calibration on real pairs: `calibration_report DIR [CALIBRATOR]`, where `DIR`
//! holds `uieb_t90`, `lsui_t400` and `euvp`, each with `input/` and `reference/` (equal file names). Prints
//! Markdown: held-out errors per set, and a table of training set × test set. With a second argument, it
//! writes a calibrator fitted to all three sets to that path.
//!
//! `calibration_report DIR --from PAIRS` fits to the pairs of another folder alone (for example synthetic
//! ones) and tests on the three sets.

use std::path::Path;
use std::time::Instant;

use use3d_atc::calibrator::{
    CalibratorParams, Dataset, PairImages, TransitionErrors, evaluate, held_out, train,
};
use use3d_atc::extractor::ExtractorSettings;
use use3d_atc::progress::unwatched;
use use3d_atc::proposers::Fusion;
use use3d_io_image::read_image;

type Anyhow = Box<dyn std::error::Error>;

fn pairs(dir: &Path) -> Result<Vec<String>, Anyhow> {
    let mut names = Vec::new();
    for entry in std::fs::read_dir(dir.join("input"))? {
        let name = entry?.file_name().to_string_lossy().into_owned();
        if dir.join("reference").join(&name).exists() {
            names.push(name);
        }
    }
    names.sort();
    Ok(names)
}

fn row(errors: &TransitionErrors) -> String {
    [errors.global, errors.local, errors.centered]
        .map(|e| format!("{:.3} → {:.3} ({:.2}×)", e.before, e.after, e.ratio()))
        .join(" | ")
}

fn dataset(dir: &Path) -> Result<Dataset, Anyhow> {
    let started = Instant::now();
    let images = pairs(dir)?.into_iter().map(|file| PairImages {
        images: read_image(&dir.join("input").join(&file))
            .and_then(|a| Ok((a, read_image(&dir.join("reference").join(&file))?)))
            .map_err(Box::from),
        name: file,
    });
    let dataset = Dataset::build(images, &Fusion, &ExtractorSettings::default(), &mut unwatched)?;
    eprintln!(
        "{}: {} pairs, {} cells, {} left out, {:.1} s",
        dir.display(),
        dataset.examples.len(),
        dataset.examples.iter().map(|e| e.cells.len()).sum::<usize>(),
        dataset.skipped.len(),
        started.elapsed().as_secs_f64()
    );
    Ok(dataset)
}

const BETWEEN: &str = "\n| trained on | tested on | global | local | local, centred |\n|---|---|---|---|---|";

fn main() -> Result<(), Anyhow> {
    let root = std::env::args().nth(1).ok_or("usage: calibration_report DIR [CALIBRATOR | --from PAIRS]")?;
    let params = CalibratorParams::default();
    let mut sets: Vec<(String, Dataset)> = Vec::new();
    for name in ["uieb_t90", "lsui_t400", "euvp"] {
        sets.push((name.to_string(), dataset(&Path::new(&root).join(name))?));
    }
    if std::env::args().nth(2).as_deref() == Some("--from") {
        let from = std::env::args().nth(3).ok_or("--from: expected a folder of pairs")?;
        let calibrator = train(&dataset(Path::new(&from))?, &params, &from, &mut unwatched)?;
        println!("{BETWEEN}");
        for (tested, other) in &sets {
            println!("| {from} | {tested} | {} |", row(&evaluate(&calibrator, &other.examples)));
        }
        return Ok(());
    }

    println!("| pairs | fitted / tested | global | local | local, centred |\n|---|---|---|---|---|");
    let mut everything = sets[0].1.subset(&[]);
    everything.examples = sets.iter().flat_map(|(_, d)| d.examples.clone()).collect();
    sets.push(("all three".into(), everything));
    for (name, dataset) in &sets {
        // Three folds, so that every pair is tested once; each fit chooses its last step on its own
        // held-out pairs.
        let folds = 3;
        let mut sum = [[0.0; 2]; 3];
        let started = Instant::now();
        let count = dataset.examples.len();
        let order = held_out(dataset, &params).map(|(mut fitted, tested)| {
            fitted.extend(tested);
            fitted
        });
        let order = order.ok_or("too few pairs")?;
        for fold in 0..folds {
            let (mut fitted, mut tested) = (Vec::new(), Vec::new());
            for (i, &pair) in order.iter().enumerate() {
                if i % folds == fold { tested.push(pair) } else { fitted.push(pair) }
            }
            let calibrator = train(&dataset.subset(&fitted), &params, name, &mut unwatched)?;
            let e = evaluate(&calibrator, tested.iter().map(|&i| &dataset.examples[i]));
            let share = tested.len() as f64 / count as f64;
            for (s, e) in sum.iter_mut().zip([e.global, e.local, e.centered]) {
                s[0] += share * e.before;
                s[1] += share * e.after;
            }
        }
        let cells = sum.map(|[b, a]| format!("{b:.3} → {a:.3} ({:.2}×)", a / b)).join(" | ");
        println!("| {name} | {folds}-fold of {count} | {cells} |");
        eprintln!("{name}: {:.1} s per fit", started.elapsed().as_secs_f64() / folds as f64);
    }

    if let Some(path) = std::env::args().nth(2) {
        let started = Instant::now();
        let calibrator = train(&sets[3].1, &params, "uieb_t90, lsui_t400, euvp", &mut unwatched)?;
        eprintln!("trained with a held-out report in {:.1} s", started.elapsed().as_secs_f64());
        std::fs::write(path, calibrator.to_bytes()?)?;
    }

    println!("{BETWEEN}");
    for (trained, dataset) in &sets[..3] {
        let calibrator = train(dataset, &params, trained, &mut unwatched)?;
        for (tested, other) in sets[..3].iter().filter(|(tested, _)| tested != trained) {
            println!("| {trained} | {tested} | {} |", row(&evaluate(&calibrator, &other.examples)));
        }
    }
    for left_out in 0..3 {
        let mut rest = sets[0].1.subset(&[]);
        rest.examples = (0..3).filter(|&i| i != left_out).flat_map(|i| sets[i].1.examples.clone()).collect();
        let calibrator = train(&rest, &params, "two sets", &mut unwatched)?;
        let (name, dataset) = &sets[left_out];
        println!("| the other two | {name} | {} |", row(&evaluate(&calibrator, &dataset.examples)));
    }
    Ok(())
}
