//! Measures the cost of watching, with the built command:
//! `cargo bench -p use3d --bench watch -- SCENE_DIR CAPTURE_DIR [STEPS]`.
//!
//! * pictures of a scene per second, drawn by the server, requested by one page one after another;
//! * a page with 100 requests per second: the number of drawn pictures, and the age of a drawn one;
//! * eight pages at once, beside one client that reads nothing and one that sends nothing: pictures, and the
//!   most memory taken;
//! * a training of STEPS steps (default: 1500) alone and with a page that moves all the time, in turns: time,
//!   and processor time, which other programs disturb less. Both include costs that occur once, about a
//!   second: the photographs for the page, and the wait for its last request.

#[path = "../tests/viewer/mod.rs"]
mod viewer;

use std::net::TcpStream;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use use3d_numerics::math;
use viewer::{Ended, Viewer};

const WIDTH: usize = 640;
const HEIGHT: usize = 360;
/// Measuring time of each row of the table.
const WHILE: Duration = Duration::from_secs(8);
const ROUNDS: usize = 3;

fn main() {
    let words: Vec<String> = std::env::args().skip(1).filter(|word| word != "--bench").collect();
    let [scene, capture, rest @ ..] = &words[..] else {
        println!("left out: cargo bench -p use3d --bench watch -- SCENE_DIR CAPTURE_DIR [STEPS]");
        return;
    };
    let steps: usize = rest.first().map_or(1500, |steps| steps.parse().expect("STEPS is a whole number"));
    println!("{} cores", std::thread::available_parallelism().map_or(1, usize::from));
    pictures(scene, capture);
    training(capture, steps);
}

fn command() -> Command {
    Command::new(env!("CARGO_BIN_EXE_use3d"))
}

/// The `i`th request of page `page`: a swim around the first camera.
fn look(header: &Value, page: &str, i: usize, mode: &str, moving: bool) -> Value {
    let view = &header["cameras"][0];
    let turn = i as f64 * 0.1;
    let eye: Vec<f64> = [math::sin(turn), 0.3 * math::cos(turn), 0.0]
        .iter()
        .enumerate()
        .map(|(k, by)| view["eye"][k].as_f64().unwrap_or(0.0) + 0.05 * by)
        .collect();
    let scale = WIDTH as f64 / view["width"].as_f64().unwrap_or(WIDTH as f64);
    let focal = view["lens"][0].as_f64().unwrap_or(WIDTH as f64) * scale;
    json!({
        "page": page, "mode": mode, "left": null, "at": 0.5, "strength": 1, "water": 1, "moving": moving,
        "camera": { "eye": eye, "rotation": view["rotation"], "lens": [focal, focal, WIDTH / 2, HEIGHT / 2], "width": WIDTH, "height": HEIGHT },
    })
}

fn pictures(scene: &str, capture: &str) {
    let mut child = command()
        .args(["-q", "view", scene, "--cameras", capture, "--no-open"])
        .stdout(Stdio::piped())
        .spawn()
        .map(Ended)
        .expect("the command starts");
    let viewer = Viewer::of(child.0.stdout.take().expect("a pipe"));
    let header = viewer.header();
    println!("\n{scene}: {} Gaussians, {WIDTH} × {HEIGHT}\n", header["count"]);
    println!(
        "| asked for | pictures per second | whole resolution | longest wait ms |\n|---|---:|---:|---:|"
    );
    for (mode, moving) in [
        ("reconstruction", false),
        ("reconstruction", true),
        ("enhanced-clear", false),
        ("enhanced-clear", true),
    ] {
        let (mut drawn, mut longest, mut i) = (0, Duration::ZERO, 0);
        let ask = |i| viewer.ask("/frame", &look(&header, "one", i, mode, moving)).map(|(status, _)| status);
        // The first request makes the renderer.
        assert_eq!(ask(0), Some(200));
        let started = Instant::now();
        while started.elapsed() < WHILE {
            let asked = Instant::now();
            i += 1;
            drawn += usize::from(ask(i) == Some(200));
            longest = longest.max(asked.elapsed());
        }
        let rate = drawn as f64 / started.elapsed().as_secs_f64();
        let whole = if moving { "as time allows" } else { "yes" };
        println!("| {mode}, one after another | {rate:.1} | {whole} | {} |", longest.as_millis());
    }

    // A page whose requests come faster than pictures can be drawn.
    let (drawn, dropped, waited) = (AtomicUsize::new(0), AtomicUsize::new(0), AtomicUsize::new(0));
    let started = Instant::now();
    std::thread::scope(|threads| {
        for i in 0..(WHILE.as_millis() / 10) as usize {
            let (viewer, header, drawn, dropped, waited) = (&viewer, &header, &drawn, &dropped, &waited);
            threads.spawn(move || {
                let asked = Instant::now();
                match viewer.ask("/frame", &look(header, "hasty", i, "reconstruction", true)) {
                    Some((200, _)) => {
                        drawn.fetch_add(1, Ordering::Relaxed);
                        waited.fetch_max(asked.elapsed().as_millis() as usize, Ordering::Relaxed);
                    }
                    _ => {
                        dropped.fetch_add(1, Ordering::Relaxed);
                    }
                }
            });
            std::thread::sleep(Duration::from_millis(10));
        }
    });
    let (drawn, dropped) = (drawn.into_inner(), dropped.into_inner());
    println!(
        "| 100 times a second by one page: {drawn} drawn, {dropped} overtaken | {:.1} | as time allows | {} |",
        drawn as f64 / started.elapsed().as_secs_f64(),
        waited.into_inner()
    );

    // Eight pages, and two clients that do not follow the protocol.
    let before = memory(child.0.id());
    let silent: Vec<TcpStream> =
        (0..2).filter_map(|_| TcpStream::connect(("127.0.0.1", viewer.port)).ok()).collect();
    let deaf: Vec<TcpStream> = (0..4)
        .filter_map(|i| viewer.send("/frame", &look(&header, "deaf", i, "reconstruction", false)))
        .collect();
    let drawn = AtomicUsize::new(0);
    let started = Instant::now();
    std::thread::scope(|threads| {
        for page in 0..8 {
            let (viewer, header, drawn) = (&viewer, &header, &drawn);
            threads.spawn(move || {
                let mut i = 0;
                while started.elapsed() < WHILE {
                    i += 1;
                    let asked = look(header, &format!("page {page}"), i, "reconstruction", true);
                    let answer = viewer.ask("/frame", &asked);
                    drawn.fetch_add(
                        usize::from(answer.is_some_and(|(status, _)| status == 200)),
                        Ordering::Relaxed,
                    );
                }
            });
        }
    });
    let rate = drawn.into_inner() as f64 / started.elapsed().as_secs_f64();
    println!(
        "| eight pages beside {} that read nothing and {} that say nothing | {rate:.1} in all | as time allows | |",
        deaf.len(),
        silent.len()
    );
    println!("\nmost memory: {before} MiB with one page, {} MiB with all of them", memory(child.0.id()));
}

/// The most memory that a process has taken so far, in MiB; zero if the system does not report it.
fn memory(process: u32) -> usize {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    line.and_then(|line| line.trim().trim_end_matches(" kB").trim().parse::<usize>().ok())
        .map_or(0, |kib| kib / 1024)
}

/// Processor seconds of all commands that have ended so far, as Linux counts them (in hundredths).
fn processor_seconds() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // The name in brackets may contain any character; children's user and system times are the 14th and 15th
    // field after it.
    let fields: Vec<&str> = stat.rsplit_once(')').map_or("", |(_, rest)| rest).split_whitespace().collect();
    let ticks = |i: usize| fields.get(i).and_then(|field| field.parse::<f64>().ok()).unwrap_or(f64::NAN);
    (ticks(13) + ticks(14)) / 100.0
}

fn training(capture: &str, steps: usize) {
    let place = tempfile::tempdir().expect("a folder");
    let train = |out: &str, watched: bool| {
        let out = place.path().join(out);
        let mut run = command();
        run.args(["-q", "reconstruct", capture, "--set", &format!("iterations={steps}"), "--out"]).arg(&out);
        if watched {
            run.args(["--view", "--no-open"]).stderr(Stdio::piped());
        }
        let (started, before) = (Instant::now(), processor_seconds());
        let mut child = run.spawn().map(Ended).expect("the command starts");
        let over = Arc::new(AtomicBool::new(false));
        let page = child.0.stderr.take().map(|printed| {
            let over = Arc::clone(&over);
            std::thread::spawn(move || {
                let viewer = Viewer::of(printed);
                let header = viewer.header();
                let mut drawn = 0;
                while !over.load(Ordering::Relaxed) {
                    let asked = look(&header, "page", drawn, "reconstruction", true);
                    match viewer.ask("/frame", &asked) {
                        Some(_) => drawn += 1,
                        None => break,
                    }
                }
                drawn
            })
        });
        assert!(child.0.wait().expect("it ends").success());
        let took = [started.elapsed().as_secs_f64(), processor_seconds() - before];
        over.store(true, Ordering::Relaxed);
        (took, page.map_or(0, |page| page.join().unwrap_or(0)))
    };
    println!("\n{capture}: {steps} steps\n");
    println!(
        "| round | alone s | watched s | cost | processor alone s | watched s | cost | pictures |\n|---|---:|---:|---:|---:|---:|---:|---:|"
    );
    let mut costs = Vec::new();
    for round in 1..=ROUNDS {
        let (alone, _) = train(&format!("alone {round}"), false);
        let (watched, drawn) = train(&format!("watched {round}"), true);
        let [wall, processor] = [0, 1].map(|i| 100.0 * (watched[i] / alone[i] - 1.0));
        println!(
            "| {round} | {:.2} | {:.2} | {wall:.1} % | {:.2} | {:.2} | {processor:.1} % | {drawn} |",
            alone[0], watched[0], alone[1], watched[1]
        );
        costs.push([wall, processor]);
    }
    let mean = |i: usize| costs.iter().map(|cost: &[f64; 2]| cost[i]).sum::<f64>() / ROUNDS as f64;
    println!("\nmean cost {:.1} % of the time, {:.1} % of the processor's", mean(0), mean(1));
}
