//! Draws pictures for pages, one after another, in one thread.
//!
//! Every page has at most one waiting request. A newer request replaces it, and the older one is answered
//! with [`DrawingAnswer::Dropped`]. A moving picture is drawn at reduced size (1, ½, ⅓ or ¼ of each side), so
//! that it takes [`MOVING`] at the pace of the pictures before it. A still one is drawn at full size, or so
//! that it takes [`STILL`] while a training runs.

use std::collections::VecDeque;
use std::io;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use jpeg_encoder::{ColorType, Encoder};
use rayon::ThreadPool;
use use3d_capture::{Camera, Image};
use use3d_render::white::{Patch, patch};
use use3d_render::{Mode, Rendering, SceneRenderer, picture};
use use3d_scene::white::Gains;

use crate::live::Live;

/// Time budget of a picture while it moves.
const MOVING: Duration = Duration::from_millis(60);
/// Time budget of a still picture while a training runs.
const STILL: Duration = Duration::from_millis(300);
/// Divisors of the sides of a picture.
const LADDER: [usize; 4] = [1, 2, 3, 4];
/// Largest number of pages that are drawn for at a time.
const PAGES: usize = 8;
/// Quality of a picture that will soon be followed by another.
const JPEG_QUALITY: u8 = 70;

/// The picture to draw.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct PictureRequest {
    /// The camera in the scene's frame.
    pub(crate) camera: Camera,
    pub(crate) mode: Mode,
    /// The mode on the left of the divider, and the position of the divider as a share of the width.
    pub(crate) left: Option<(Mode, f64)>,
    pub(crate) strength: f32,
    pub(crate) water: f32,
    /// The white balance.
    pub(crate) white: Gains,
    pub(crate) moving: bool,
}

#[derive(Clone, Debug, PartialEq)]
pub(crate) enum DrawingRequest {
    Picture(PictureRequest),
    /// The median depth of the pixels that such a camera sees.
    Depth(Camera),
    /// The colour of a spot, for the white balance.
    Patch {
        camera: Camera,
        x: f64,
        y: f64,
        /// The share of the water with which `enhanced` is shown.
        water: f32,
    },
}

#[derive(Clone, Debug, PartialEq)]
pub(crate) enum DrawingAnswer {
    Picture {
        bytes: Vec<u8>,
        kind: &'static str,
        /// The number that its sides were divided by.
        divisor: usize,
        /// The version of the scene that it shows.
        version: u64,
    },
    Depth(Option<f32>),
    /// The colour of a spot.
    Patch(Patch),
    /// The reason why a spot has no colour.
    NoPatch(String),
    /// A newer request of the same page replaced this one, or there are too many pages.
    Dropped,
    Failed(String),
}

#[derive(Debug)]
struct DrawingJob {
    page: String,
    wanted: DrawingRequest,
    answer: Sender<DrawingAnswer>,
}

/// Requests, oldest page first.
#[derive(Debug, Default)]
struct Queue {
    jobs: VecDeque<DrawingJob>,
    closed: bool,
    /// Nothing is drawn before this time.
    rests_until: Option<Instant>,
}

#[derive(Debug)]
pub(crate) struct Drawing {
    live: Arc<Live>,
    queue: Mutex<Queue>,
    changed: Condvar,
}

impl Drawing {
    pub(crate) fn new(live: Arc<Live>) -> Arc<Self> {
        Arc::new(Self { live, queue: Mutex::default(), changed: Condvar::new() })
    }

    /// Adds a request for a drawing to the queue.
    pub(crate) fn ask(&self, page: &str, wanted: DrawingRequest) -> Receiver<DrawingAnswer> {
        let (answer, drawn) = channel();
        let mut queue = self.queue.lock().unwrap_or_else(PoisonError::into_inner);
        let picture = |w: &DrawingRequest| matches!(w, DrawingRequest::Picture(_));
        let full = queue.jobs.len() >= 2 * PAGES;
        let waits =
            queue.jobs.iter_mut().find(|job| job.page == page && picture(&job.wanted) == picture(&wanted));
        match waits {
            Some(job) => {
                // The receiver may be gone already; then the answer is lost.
                let _ = std::mem::replace(&mut job.answer, answer).send(DrawingAnswer::Dropped);
                job.wanted = wanted;
            }
            None if full => {
                let _ = answer.send(DrawingAnswer::Dropped);
            }
            None => queue.jobs.push_back(DrawingJob { page: page.into(), wanted, answer }),
        }
        self.changed.notify_all();
        drawn
    }

    /// Ends the drawing thread.
    pub(crate) fn close(&self) {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner).closed = true;
        self.changed.notify_all();
    }

    /// The next request, as soon as it may be drawn; `None` at the end.
    fn next(&self) -> Option<DrawingJob> {
        let mut queue = self.queue.lock().unwrap_or_else(PoisonError::into_inner);
        loop {
            if queue.closed {
                return None;
            }
            let left =
                queue.rests_until.map_or(Duration::ZERO, |at| at.saturating_duration_since(Instant::now()));
            // If the training was paused meanwhile, no rest is needed.
            let rests = !left.is_zero() && self.live.rest(Duration::ZERO).is_some();
            if !rests && let Some(job) = queue.jobs.pop_front() {
                return Some(job);
            }
            let wait = if rests { left.min(Duration::from_millis(100)) } else { Duration::from_secs(60) };
            queue = self.changed.wait_timeout(queue, wait).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Draws until the queue is closed.
    pub(crate) fn work(&self) {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).thread_name(|_| "viewer".into()).build();
        let Ok(beside) = pool.inspect_err(|e| tracing::warn!("the viewer cannot draw: {e}")) else { return };
        let mut pace = Pace::default();
        // The request after the last drawing, if it needs another renderer.
        let mut next = None;
        while let Some(job) = next.take().or_else(|| self.next()) {
            let Some((shown, version)) = self.live.shown() else {
                let _ = job.answer.send(DrawingAnswer::Failed("there is no scene yet".into()));
                continue;
            };
            let (strength, water) = amounts(&job.wanted);
            let made = on(&beside, self.live.rest(Duration::ZERO).is_some(), || {
                SceneRenderer::new(&shown.scene, strength).and_then(|renderer| renderer.with_water(water))
            });
            let mut renderer = match made {
                Ok(renderer) => renderer,
                Err(error) => {
                    let _ = job.answer.send(DrawingAnswer::Failed(error.to_string()));
                    continue;
                }
            };
            next = Some(job);
            // The renderer is kept as long as the scene and the amounts stay the same.
            while let Some(job) = next.take_if(|job| {
                (self.live.version(), amounts(&job.wanted)) == (version, (strength, water))
                    || matches!(job.wanted, DrawingRequest::Depth(_)) && self.live.version() == version
            }) {
                let started = Instant::now();
                let trains = self.live.rest(Duration::ZERO).is_some();
                let drawn = on(&beside, trains, || match &job.wanted {
                    DrawingRequest::Picture(look) => pace.draw(&mut renderer, look, version, trains),
                    DrawingRequest::Depth(camera) => depth(&mut renderer, camera),
                    DrawingRequest::Patch { camera, x, y, .. } => {
                        renderer.gains = Gains::ONE;
                        let found = patch(&mut renderer, camera, *x, *y);
                        Ok(found.map_or_else(|e| DrawingAnswer::NoPatch(e.to_string()), DrawingAnswer::Patch))
                    }
                });
                let _ = job.answer.send(drawn.unwrap_or_else(|e| DrawingAnswer::Failed(e.to_string())));
                let rest = self.live.rest(started.elapsed());
                self.queue.lock().unwrap_or_else(PoisonError::into_inner).rests_until =
                    rest.map(|rest| Instant::now() + rest);
                next = self.next();
            }
        }
    }
}

/// The strength and the share of water that a renderer is made for.
fn amounts(wanted: &DrawingRequest) -> (f32, f32) {
    match wanted {
        DrawingRequest::Picture(look) => (look.strength, look.water),
        DrawingRequest::Depth(_) => (1.0, 1.0),
        DrawingRequest::Patch { water, .. } => (1.0, *water),
    }
}

/// Runs on one thread while a training runs, else on all threads.
fn on<T: Send>(beside: &ThreadPool, trains: bool, work: impl FnOnce() -> T + Send) -> T {
    if trains { beside.install(work) } else { work() }
}

/// The measured drawing time per pixel.
#[derive(Debug, Default)]
struct Pace {
    /// Seconds, without a training and during a training.
    per_pixel: [Option<f64>; 2],
}

impl Pace {
    fn divisor(&self, look: &PictureRequest, trains: bool) -> usize {
        let budget = match (look.moving, trains) {
            (true, _) => MOVING,
            (false, true) => STILL,
            (false, false) => return 1,
        };
        let Some(per_pixel) = self.per_pixel[usize::from(trains)] else { return 2 };
        let k = &look.camera.intrinsics;
        let whole = per_pixel * (k.width * k.height) as f64 * if look.left.is_some() { 2.0 } else { 1.0 };
        let fits = |d: &usize| whole / (d * d) as f64 <= budget.as_secs_f64();
        LADDER.into_iter().find(fits).unwrap_or(LADDER[LADDER.len() - 1])
    }

    fn draw(
        &mut self,
        renderer: &mut SceneRenderer<'_>,
        look: &PictureRequest,
        version: u64,
        trains: bool,
    ) -> io::Result<DrawingAnswer> {
        let divisor = self.divisor(look, trains);
        let k = look.camera.intrinsics;
        let (width, height) = (k.width.div_ceil(divisor), k.height.div_ceil(divisor));
        let (sx, sy) = (width as f64 / k.width as f64, height as f64 / k.height as f64);
        let camera = Camera { intrinsics: k.scaled(sx, sy, width, height), pose: look.camera.pose };
        let started = Instant::now();
        renderer.gains = look.white;
        let mut modes = vec![look.mode];
        modes.extend(look.left.map(|(left, _)| left));
        let frames = renderer.render(&camera, &modes).map_err(io::Error::other)?;
        let image = joined(look, &modes, &frames);
        let one = started.elapsed().as_secs_f64() / (width * height * modes.len()) as f64;
        let known = &mut self.per_pixel[usize::from(trains)];
        *known = Some(known.map_or(one, |known| 0.7 * known + 0.3 * one));
        let exact = divisor == 1 && !look.moving && !trains;
        let (bytes, kind) = encoded(&image, exact)?;
        Ok(DrawingAnswer::Picture { bytes, kind, divisor, version })
    }
}

/// The picture of a look, joined from both sides of the divider.
fn joined(look: &PictureRequest, modes: &[Mode], frames: &[Rendering]) -> Image {
    let mut sides = modes.iter().zip(frames).map(|(mode, frame)| picture(*mode, frame));
    let Some(mut image) = sides.next() else { return Image::new(0, 0) };
    if let (Some(left), Some((_, at))) = (sides.next(), look.left) {
        let cut = (at * image.width() as f64).round() as usize;
        for y in 0..image.height() {
            for x in 0..cut.min(image.width()) {
                image.set_pixel(x, y, left.pixel(x, y));
            }
        }
    }
    image
}

/// A picture encoded for a page, without loss if it is a final one.
fn encoded(image: &Image, exact: bool) -> io::Result<(Vec<u8>, &'static str)> {
    // No side of a picture is longer than 4096 pixels.
    let (width, height) = (image.width() as u16, image.height() as u16);
    let pixels = image.to_8bit().to_interleaved();
    let mut bytes = Vec::new();
    if exact {
        PngEncoder::new_with_quality(&mut bytes, CompressionType::Fast, FilterType::Sub)
            .write_image(&pixels, width.into(), height.into(), ExtendedColorType::Rgb8)
            .map_err(io::Error::other)?;
        return Ok((bytes, "image/png"));
    }
    Encoder::new(&mut bytes, JPEG_QUALITY)
        .encode(&pixels, width, height, ColorType::Rgb)
        .map_err(io::Error::other)?;
    Ok((bytes, "image/jpeg"))
}

fn depth(renderer: &mut SceneRenderer<'_>, camera: &Camera) -> io::Result<DrawingAnswer> {
    let frames = renderer.render(camera, &[Mode::Depth, Mode::Alpha]).map_err(io::Error::other)?;
    let [Rendering::Scalar(depth), Rendering::Scalar(alpha)] = &frames[..] else {
        return Ok(DrawingAnswer::Depth(None));
    };
    let there =
        depth.data().iter().zip(alpha.data()).filter(|(depth, alpha)| **depth > 0.0 && **alpha > 0.25);
    let mut depths: Vec<f32> = there.map(|(depth, _)| *depth).collect();
    depths.sort_unstable_by(f32::total_cmp);
    Ok(DrawingAnswer::Depth(depths.get(depths.len() / 2).copied()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_capture::{Frame, Intrinsics, Pose};
    use use3d_medium::MediumModel;
    use use3d_scene::Scene;
    use use3d_splat::Gaussians;

    use crate::live::Shown;

    fn look(width: usize) -> PictureRequest {
        let intrinsics = Intrinsics { width, height: 48, fx: 40.0, fy: 40.0, cx: 32.0, cy: 24.0 };
        PictureRequest {
            camera: Camera { intrinsics, pose: Pose::IDENTITY },
            mode: Mode::Clear,
            left: None,
            strength: 1.0,
            water: 1.0,
            white: Gains::ONE,
            moving: false,
        }
    }

    #[test]
    fn of_many_looks_of_a_page_the_newest_is_drawn_and_the_others_are_told() {
        let live = Arc::new(Live::new("", None));
        let gaussians = Gaussians {
            sh_degree: 0,
            means: vec![[0.0, 0.0, 2.0]],
            log_scales: vec![[-1.5; 3]],
            quaternions: vec![[1.0, 0.0, 0.0, 0.0]],
            opacity_logits: vec![2.0],
            sh: vec![[[0.5, 0.2, -0.3]; 16]],
        };
        let medium = MediumModel::None;
        let scene = Scene { gaussians, frame: Frame::IDENTITY, medium, medium_degree: 0, enhancement: None };
        live.show(Shown::new("reef".into(), scene, Vec::new(), None));
        // Nothing is drawn yet, as if one large picture took all this time.
        let drawing = Drawing::new(live);
        let mut asked: Vec<_> =
            (64..84).map(|width| drawing.ask("a", DrawingRequest::Picture(look(width)))).collect();
        // Another page's request, and a depth request of the same page, replace no other.
        let other = drawing.ask("b", DrawingRequest::Picture(look(30)));
        let depth = drawing.ask("a", DrawingRequest::Depth(look(9).camera));
        let newest = asked.pop().expect("the last one");
        assert!(asked.iter().all(|older| older.try_recv() == Ok(DrawingAnswer::Dropped)));
        let worker = drawing.clone();
        let works = std::thread::spawn(move || worker.work());
        for (drawn, width) in [(newest, 83), (other, 30)] {
            let Ok(DrawingAnswer::Picture { bytes, kind, divisor, .. }) = drawn.recv() else {
                panic!("no picture")
            };
            assert_eq!((kind, divisor), ("image/png", 1));
            assert_eq!(bytes[16..20], u32::to_be_bytes(width));
        }
        assert!(matches!(depth.recv(), Ok(DrawingAnswer::Depth(_))));
        drawing.close();
        works.join().expect("it ends");
    }

    #[test]
    fn a_picture_is_as_small_as_its_time_asks_for() {
        let still = look(100);
        let moving = PictureRequest { moving: true, ..still };
        let both = PictureRequest { left: Some((Mode::Depth, 0.5)), ..moving };
        // For 4800 pixels: the time for all of them as a share of the time of a moving picture.
        let pace = |share: f64| {
            let one = Some(share * MOVING.as_secs_f64() / 4800.0);
            Pace { per_pixel: [one, one] }
        };
        for (share, alone, halves) in [(0.4, 1, 1), (0.9, 1, 2), (3.9, 2, 3), (8.9, 3, 4), (100.0, 4, 4)] {
            assert_eq!(pace(share).divisor(&moving, false), alone, "{share}");
            assert_eq!(pace(share).divisor(&both, false), halves, "{share}");
        }
        // A still picture has full size; during a training it has more time than a moving one.
        assert_eq!(pace(100.0).divisor(&still, false), 1);
        assert_eq!(pace(4.9).divisor(&still, true), 1);
        assert_eq!(pace(5.1).divisor(&still, true), 2);
        // While the pace is unknown, a picture has half the size, except a still one without a training.
        assert_eq!(Pace::default().divisor(&moving, false), 2);
        assert_eq!(Pace::default().divisor(&still, false), 1);
    }
}
