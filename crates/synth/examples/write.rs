//! Writes a synthetic capture, or pairs: `write capture|pairs OUT [WATER] [SEED]`.

use std::path::Path;
use std::process::ExitCode;

use use3d_synth::{CaptureParams, PairsParams, write_capture, write_pairs};

fn run(kind: &str, out: &Path, water: Option<&str>, seed: u64) -> Result<(), Box<dyn std::error::Error>> {
    let mut progress = |done: usize, total: usize| eprint!("\r{done} of {total} ");
    if kind == "pairs" {
        write_pairs(&PairsParams { seed, ..PairsParams::default() }, out, &mut progress)?;
    } else {
        let mut params = CaptureParams { seed, ..CaptureParams::default() };
        if let Some(name) = water {
            params.water = name.parse()?;
        }
        write_capture(&params, out, &mut progress)?;
    }
    Ok(())
}

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().collect();
    let text = |i: usize| arguments.get(i).map(String::as_str);
    let (Some(kind), Some(out)) = (text(1), text(2)) else {
        eprintln!("usage: write capture|pairs OUT [WATER] [SEED]");
        return ExitCode::from(2);
    };
    let seed = text(4).and_then(|s| s.parse().ok()).unwrap_or(42);
    let start = std::time::Instant::now();
    match run(kind, Path::new(out), text(3), seed) {
        Ok(()) => {
            eprintln!("\n{:.1} s", start.elapsed().as_secs_f64());
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("\n{error}");
            ExitCode::FAILURE
        }
    }
}
