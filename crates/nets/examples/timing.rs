//! Seconds, processor seconds and peak memory of every network for one picture size, with stand-in weights
//! (same shapes, same work).
//!
//! Run `cargo run --release -p use3d-nets --example timing [-- WIDTHxHEIGHT [NETWORK]]`. Without a network,
//! each network runs in a process of its own, so that the peaks are separate.

use std::time::Instant;

use use3d_capture::Image;
use use3d_nets::weights::StandIn;
use use3d_nets::{
    DepthAnythingSize, DepthAnythingV2, InputPolicy, Lpips, Musiq, NetError, Nu2Net, Raft, URanker,
};
use use3d_numerics::math;

const NETWORKS: [&str; 9] =
    ["nu2net", "nu2net-scene", "da2-small", "da2-base", "da2-large", "lpips", "raft", "uranker", "musiq"];

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let size = arguments.first().map_or("1400x933", String::as_str);
    let (width, height) = size.split_once('x').ok_or("the size is WIDTHxHEIGHT")?;
    let (width, height) = (width.parse()?, height.parse()?);
    if let Some(network) = arguments.get(1) {
        return Ok(measure(network, width, height)?);
    }
    println!("{size}, {} threads\n", rayon::current_num_threads());
    println!(
        "| network | seconds | processor seconds | peak memory, MiB (with weights) |\n| --- | --- | --- | --- |"
    );
    for network in NETWORKS {
        std::process::Command::new(std::env::current_exe()?).args([size, network]).status()?;
    }
    Ok(())
}

fn measure(network: &str, width: usize, height: usize) -> Result<(), NetError> {
    let (a, b) = (picture(width, height, 0.0), picture(width, height, 3.0));
    let weights = &mut StandIn;
    match network {
        "nu2net" => {
            let net = Nu2Net::from_weights(weights)?;
            report("Nu2Net, full size", || net.enhance_with(&a, InputPolicy::MultiplesOf16).map(drop))
        }
        "nu2net-scene" => {
            let net = Nu2Net::from_weights(weights)?;
            report("Nu2Net, long side 384 (scenes)", || net.enhance(&a).map(drop))
        }
        "da2-small" => depth("Depth Anything V2 Small", DepthAnythingSize::Small, &a),
        "da2-base" => depth("Depth Anything V2 Base", DepthAnythingSize::Base, &a),
        "da2-large" => depth("Depth Anything V2 Large", DepthAnythingSize::Large, &a),
        "lpips" => {
            let net = Lpips::from_weights(weights, &mut StandIn)?;
            report("LPIPS, one pair", || net.distance(&a, &b).map(drop))
        }
        "raft" => {
            let net = Raft::from_weights(weights)?;
            report("RAFT-Large, 12 updates", || net.flow(&a, &b).map(drop))
        }
        "uranker" => {
            let net = URanker::from_weights(weights)?;
            report("URanker", || net.score(&a).map(drop))
        }
        "musiq" => {
            let net = Musiq::from_weights(weights)?;
            report("MUSIQ", || net.score(&a).map(drop))
        }
        other => {
            let problem = format!("no such network; one of {}", NETWORKS.join(", "));
            println!("{other}: {problem}");
            Ok(())
        }
    }
}

fn depth(title: &str, size: DepthAnythingSize, image: &Image) -> Result<(), NetError> {
    let net = DepthAnythingV2::from_weights(size, &mut StandIn)?;
    report(title, || net.disparity(image).map(drop))
}

/// Reports the better of two runs (of one if a run is long). Processor seconds are the sum over all threads.
fn report(title: &str, run: impl Fn() -> Result<(), NetError>) -> Result<(), NetError> {
    let (mut best, mut processor) = (f64::INFINITY, f64::INFINITY);
    for _ in 0..2 {
        let (start, before) = (Instant::now(), processor_seconds());
        run()?;
        best = best.min(start.elapsed().as_secs_f64());
        processor = processor.min(processor_seconds() - before);
        if best > 5.0 {
            break;
        }
    }
    println!(
        "| {title} | {best:.2} | {processor:.2} | {} |",
        peak_mebibytes().map_or("?".into(), |m| m.to_string())
    );
    Ok(())
}

/// User and system time of the process so far, if the system reports it (in hundredths of a second), else 0.
fn processor_seconds() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let after_name = stat.rsplit(')').next().unwrap_or_default();
    let ticks = after_name.split_whitespace().skip(11).take(2);
    ticks.filter_map(|t| t.parse::<f64>().ok()).sum::<f64>() / 100.0
}

/// Peak resident memory of the process, if the system reports it.
fn peak_mebibytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?;
    line.trim().trim_end_matches(" kB").parse::<u64>().ok().map(|kb| kb / 1024)
}

fn picture(width: usize, height: usize, phase: f32) -> Image {
    let mut image = Image::new(width, height);
    for y in 0..height {
        for x in 0..width {
            let (u, v) = (x as f32 * 0.05 + phase, y as f32 * 0.07);
            let pixel = [math::sin(u) * math::cos(v), math::cos(u * 0.3), math::sin(v * 0.2 + u)]
                .map(|v| 0.5 + 0.4 * v);
            image.set_pixel(x, y, pixel);
        }
    }
    image
}
