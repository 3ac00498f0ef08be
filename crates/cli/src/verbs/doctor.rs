//! The abilities of this installation: the program itself, the machine, helper programs, networks and
//! graphics cards, each with its use and the way to get it if it is missing.

use std::path::Path;
use std::process::{Command, Stdio};

use serde::Serialize;
use use3d_pipeline::destination::path_text;
use use3d_workflow::machine::{self, bytes};

use crate::args::DoctorArgs;
use crate::error::Done;
use crate::version;

/// The result of one search.
#[derive(Debug, Serialize)]
struct Finding {
    /// Its name.
    name: String,
    /// True if it is there and can be used.
    found: bool,
    /// The word for it where it cannot be used.
    #[serde(skip)]
    otherwise: &'static str,
    /// The version or place that was found, or the way to get it.
    told: String,
    /// Its use.
    #[serde(rename = "use")]
    purpose: String,
}

impl Finding {
    fn new(name: &str, found: bool, told: impl Into<String>, purpose: &str) -> Self {
        Self { name: name.into(), found, otherwise: "missing", told: told.into(), purpose: purpose.into() }
    }

    /// The same with another word for what is there and cannot be used.
    fn otherwise(self, word: &'static str) -> Self {
        Self { otherwise: word, ..self }
    }
}

/// All results, by subject.
#[derive(Debug, Serialize)]
struct Report {
    version: &'static str,
    commit: &'static str,
    target: &'static str,
    features: &'static str,
    engines: &'static str,
    machine: Vec<Finding>,
    programs: Vec<Finding>,
    networks: Vec<Finding>,
    cards: Vec<Finding>,
}

/// A helper program: its name, the argument that makes it print its version, its use, and the way to get it.
const PROGRAMS: [[&str; 4]; 5] = [
    [
        "colmap",
        "help",
        "finds the cameras of your photographs (use3d prepare)",
        "sudo apt install colmap, or pip install pycolmap",
    ],
    [
        "ffmpeg",
        "-version",
        "takes frames out of films, and writes films other than .y4m",
        "install ffmpeg: https://ffmpeg.org",
    ],
    ["sbatch", "--version", "runs pipelines on a Slurm cluster (use3d submit slurm)", "comes with Slurm"],
    ["hq", "--version", "runs pipelines by HyperQueue (use3d submit hq)", "comes with HyperQueue"],
    [
        "xdg-open",
        "--version",
        "opens the viewer in your browser",
        "comes with xdg-utils; the address is printed in any case",
    ],
];

pub(crate) fn run(args: &DoctorArgs) -> Done {
    let report = Report {
        version: version::NUMBER,
        commit: version::COMMIT,
        target: version::TARGET,
        features: version::FEATURES,
        engines: version::ENGINES,
        machine: this_machine(args),
        programs: PROGRAMS.iter().map(program).collect(),
        networks: networks(args.models.as_deref()),
        cards: cards(),
    };
    if args.json {
        return crate::output::json(&report);
    }
    println!("use3d {}", version::WHOLE);
    let groups = [
        ("this machine", &report.machine),
        ("programs that help", &report.programs),
        (
            "networks by other authors (all are optional; `use3d models` lists where to get each)",
            &report.networks,
        ),
        ("graphics cards (`use3d devices` lists details)", &report.cards),
    ];
    for (title, findings) in groups {
        println!("\n{title}");
        for Finding { name, found, otherwise, told, purpose } in findings {
            let mark = if *found { "ok" } else { otherwise };
            println!("  {mark:<7}  {name}: {told}");
            if !purpose.is_empty() {
                println!("           {purpose}");
            }
        }
    }
    Ok(())
}

/// Cores, memory, and the folders that are written to.
fn this_machine(args: &DoctorArgs) -> Vec<Finding> {
    let processor = format!("{} cores, {}", machine::cores(), machine::processor());
    let mut findings = vec![Finding::new("processor", true, processor, "")];
    if let Some(memory) = machine::available_memory() {
        let told = format!("{} free", bytes(memory));
        // The memory for a capture of some hundred photographs at full size.
        let enough = memory >= 4 << 30;
        let purpose = "about 4 GB are needed for a capture at full size";
        findings.push(Finding::new("memory", enough, told, purpose).otherwise("little"));
    }
    let cache = args.cache.clone().or_else(|| use3d_config::default_cache().ok());
    for (name, folder) in [("cache", cache), ("results", std::env::current_dir().ok())] {
        let Some(folder) = folder else { continue };
        // The folder itself, or the nearest existing one above it.
        let place = folder.ancestors().find(|above| above.is_dir()).unwrap_or(&folder);
        let writable = use3d_workflow::place::check_writable(&folder).is_ok();
        let free = free_space(place).map_or_else(String::new, |free| format!(", {} free", bytes(free)));
        let refused = match (writable, name) {
            (true, _) => "",
            (false, "cache") => ", cannot be written; choose another with --cache or USE3D_CACHE",
            (false, _) => ", cannot be written; choose another with --out",
        };
        let told = format!("{}{free}{refused}", path_text(&folder));
        findings.push(Finding::new(name, writable, told, "").otherwise("problem"));
    }
    findings
}

/// The free bytes in a folder's file system, from `df`; `None` if there is no `df`.
fn free_space(folder: &Path) -> Option<u64> {
    let output = Command::new("df").arg("-Pk").arg(folder).stderr(Stdio::null()).output().ok()?;
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    // The fourth word of the second line, in units of 1024 bytes.
    text.lines().nth(1)?.split_whitespace().nth(3)?.parse::<u64>().ok()?.checked_mul(1024)
}

/// Starts a program and reads the first line of its output. A program that fails, for example because a
/// library is missing, counts as missing.
fn program([name, argument, purpose, origin]: &[&str; 4]) -> Finding {
    let said = Command::new(name).arg(argument).stdin(Stdio::null()).output();
    match said {
        Ok(output) if !output.status.success() => {
            let text = String::from_utf8_lossy(&output.stderr).into_owned();
            let why = text.lines().find(|line| !line.trim().is_empty()).unwrap_or("it fails").trim();
            let why: String = why.chars().take(90).collect();
            let told = format!("cannot run: {}", use3d_capture::name::shown(&why));
            Finding::new(name, false, told, purpose).otherwise("problem")
        }
        Ok(output) => {
            let text = String::from_utf8_lossy(&output.stdout).into_owned();
            let line = text.lines().find(|line| !line.trim().is_empty()).unwrap_or("found").trim();
            let line: String = line.chars().take(90).collect();
            Finding::new(name, true, use3d_capture::name::shown(&line), purpose)
        }
        Err(_) => Finding::new(name, false, *origin, purpose),
    }
}

fn networks(models: Option<&Path>) -> Vec<Finding> {
    let folder = models.unwrap_or(Path::new("models"));
    let looked = use3d_nets::Models::open(folder);
    let find = |known: &use3d_nets::models::CheckpointInfo| match looked.find(known.network) {
        Some(file) => Finding::new(known.title, true, path_text(&file), known.used_for),
        None => {
            let told = format!("put {} into {}", known.files.join(" or "), path_text(folder));
            Finding::new(known.title, false, told, known.used_for)
        }
    };
    use3d_nets::models::KNOWN.iter().map(find).collect()
}

/// Cards are looked for in a process of their own: drivers write warnings to its error stream, and some
/// of them end the process.
#[cfg(feature = "gpu")]
fn cards() -> Vec<Finding> {
    let purpose = "trains and draws faster than the processor: --gpu";
    let said = std::env::current_exe().and_then(|use3d| {
        Command::new(use3d).args(["devices", "--json"]).stdin(Stdio::null()).stderr(Stdio::null()).output()
    });
    let listed: serde_json::Value =
        said.ok().and_then(|output| serde_json::from_slice(&output.stdout).ok()).unwrap_or_default();
    let card = |adapter: &serde_json::Value| -> Option<Finding> {
        let name = use3d_capture::name::shown(adapter["name"].as_str()?);
        Some(match adapter["refusal"].as_str() {
            Some(refusal) => Finding::new(&name, false, refusal, purpose).otherwise("problem"),
            None if adapter["kind"] == "software" => {
                let told =
                    "passes its check, but is a software adapter on the processor; it is used only by name";
                Finding::new(&name, false, told, "").otherwise("unused")
            }
            None => Finding::new(&name, true, "passes its check", purpose),
        })
    };
    let found: Vec<Finding> = listed["adapters"].as_array().into_iter().flatten().filter_map(card).collect();
    if found.is_empty() {
        let told = "no card was found; a card needs a driver for Vulkan or Metal";
        return vec![Finding::new("graphics card", false, told, purpose)];
    }
    found
}

#[cfg(not(feature = "gpu"))]
fn cards() -> Vec<Finding> {
    vec![Finding::new("graphics card", false, "this program was built without the cargo feature `gpu`", "")]
}
