//! Measures milliseconds per image of 1400 × 933: best and median of a few runs on all threads.

use std::hint::black_box;
use std::time::Instant;

use use3d_capture::Image;
use use3d_metrics::ms_ssim::{MsSsim, RECONSTRUCTION_WEIGHTS};
use use3d_metrics::{mean_ciede2000, psnr, ssim, uciqe, uiqm};
use use3d_numerics::math;

/// A smooth picture with some texture.
fn picture(phase: f32) -> Image {
    let mut image = Image::new(1400, 933);
    for y in 0..933 {
        for x in 0..1400 {
            let (u, v) = (x as f32 * 0.013, y as f32 * 0.017);
            let t = 0.06 * ((x * 7919 + y * 104_729) % 97) as f32 / 97.0;
            let wave = |k: f32| 0.45 + 0.35 * math::sin(k * u + phase) * math::cos(k * v) + t;
            image.set_pixel(x, y, [0.6 * wave(1.0), wave(1.3), wave(0.7)]);
        }
    }
    image
}

fn time(name: &str, mut run: impl FnMut() -> f64) {
    let mut times: Vec<f64> = (0..9)
        .map(|_| {
            let start = Instant::now();
            black_box(run());
            start.elapsed().as_secs_f64() * 1e3
        })
        .collect();
    times.sort_by(f64::total_cmp);
    println!("{name:<28} best {:7.1} ms   median {:7.1} ms", times[0], times[times.len() / 2]);
}

fn main() {
    let (x, y) = (picture(0.0), picture(0.05));
    let threads = rayon::current_num_threads();
    println!("1400 x 933, {threads} threads");
    let known = "bench images are finite and of one size";
    time("PSNR", || psnr(&x, &y, None).expect(known));
    time("SSIM", || ssim(&x, &y, None).expect(known));
    let mut measure = MsSsim::default();
    let mut gradient = x.clone();
    time("MS-SSIM and its gradient", || {
        measure.value_and_gradient(&x, &y, 0.0, &RECONSTRUCTION_WEIGHTS, &mut gradient)
    });
    time("UCIQE", || uciqe(&x).expect(known).score);
    time("UIQM", || uiqm(&x).expect(known).score);
    time("CIEDE2000", || mean_ciede2000(&x, &y).expect(known));
}
