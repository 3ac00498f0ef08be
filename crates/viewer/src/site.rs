//! The answers to requests: the page, its scene, pictures, the status, and commands. All but the page are
//! JSON by `POST`.

use std::sync::Arc;
use std::time::Duration;

use glam::{DMat3, DVec3};
use serde::Deserialize;
use serde_json::json;
use use3d_capture::{Camera, CameraError, Intrinsics, Pose};
use use3d_render::Mode;
use use3d_scene::white::{GAINS, Gains};

use crate::drawing::{Drawing, DrawingAnswer, DrawingRequest, PictureRequest};
use crate::http::{HttpRequest, Response};
use crate::live::Live;

/// Longest side of a picture, pixels.
const SIDE: usize = 4096;
/// Most pixels of a picture: those of a 4K screen.
const PIXELS: usize = 3840 * 2160;
/// Longest time that a request waits for its drawing.
const PATIENCE: Duration = Duration::from_secs(60);

pub(crate) struct Site {
    live: Arc<Live>,
    drawing: Arc<Drawing>,
    page: use3d_web::Served,
}

/// A fault in a request.
#[derive(Debug, thiserror::Error)]
enum RequestError {
    #[error("the request cannot be read: {0}")]
    Form(#[from] serde_json::Error),
    #[error("a picture of {0} × {1} pixels; at most {PIXELS} are drawn")]
    Size(usize, usize),
    #[error(transparent)]
    Camera(#[from] CameraError),
    #[error("there is no mode `{0}`")]
    Mode(String),
    #[error("{0} 0 to 1")]
    Shares(&'static str),
    #[error("the gains of a white balance are {} to {}", GAINS[0], GAINS[1])]
    Gains,
    #[error("there is nothing of that kind to do here")]
    Command,
}

/// A camera as the page sends it: pixels, and rows right, down, forward.
#[derive(Debug, Deserialize)]
struct CameraWords {
    eye: [f64; 3],
    rotation: [[f64; 3]; 3],
    lens: [f64; 4],
    width: usize,
    height: usize,
}

#[derive(Debug, Deserialize)]
struct LookWords {
    page: String,
    camera: CameraWords,
    mode: String,
    left: Option<String>,
    at: f64,
    strength: f32,
    water: f32,
    /// The gains of each look, if colours are balanced.
    #[serde(default)]
    white: Option<Gains>,
    moving: bool,
}

#[derive(Debug, Deserialize)]
struct DepthWords {
    page: String,
    camera: CameraWords,
}

#[derive(Debug, Deserialize)]
struct PatchWords {
    page: String,
    camera: CameraWords,
    x: f64,
    y: f64,
    water: f32,
}

#[derive(Debug, Deserialize)]
struct SectionWords {
    name: String,
}

#[derive(Debug, Deserialize)]
struct CommandWords {
    name: String,
    share: Option<f64>,
}

impl CameraWords {
    fn camera(&self) -> Result<Camera, RequestError> {
        let (width, height) = (self.width, self.height);
        if width > SIDE || height > SIDE || width * height > PIXELS {
            return Err(RequestError::Size(width, height));
        }
        let [fx, fy, cx, cy] = self.lens;
        let [right, down, forward] = self.rotation.map(DVec3::from_array);
        let rotation = DMat3::from_cols(right, down, forward).transpose();
        let pose = Pose::from_center(rotation, DVec3::from_array(self.eye));
        let camera = Camera { intrinsics: Intrinsics { width, height, fx, fy, cx, cy }, pose };
        camera.validate()?;
        Ok(camera)
    }
}

impl LookWords {
    fn look(&self) -> Result<PictureRequest, RequestError> {
        let mode = |name: &str| Mode::from_name(name).ok_or_else(|| RequestError::Mode(name.into()));
        let shares = [f64::from(self.strength), f64::from(self.water), self.at];
        if shares.iter().any(|share| !(0.0..=1.0).contains(share)) {
            return Err(RequestError::Shares("strength, water and the divider's place are"));
        }
        let left = self.left.as_deref().map(mode).transpose()?;
        let white = self.white.unwrap_or(Gains::ONE);
        let [least, most] = GAINS;
        let gains = [white.clear, white.enhanced, white.enhanced_clear];
        if gains.as_flattened().iter().any(|gain| !(least..=most).contains(gain)) {
            return Err(RequestError::Gains);
        }
        Ok(PictureRequest {
            camera: self.camera.camera()?,
            mode: mode(&self.mode)?,
            left: left.map(|left| (left, self.at)),
            strength: self.strength,
            water: self.water,
            white,
            moving: self.moving,
        })
    }
}

impl Site {
    pub(crate) fn new(live: Arc<Live>, drawing: Arc<Drawing>) -> Self {
        Self { live, drawing, page: use3d_web::served() }
    }

    /// The answer to a request that passed the guard.
    pub(crate) fn answer(&self, request: &HttpRequest) -> Response {
        if request.method == "GET" {
            let mut page = Response::new(200, "text/html; charset=utf-8", self.page.html.clone());
            page.fields = vec![
                ("Content-Security-Policy", format!("{}; frame-ancestors 'none'", self.page.policy)),
                ("X-Frame-Options", "DENY".into()),
            ];
            return page;
        }
        self.live.looked();
        self.data(request).unwrap_or_else(|fault| Response::text(400, &fault.to_string()))
    }

    /// The answer to a `POST`, or the fault in it.
    fn data(&self, request: &HttpRequest) -> Result<Response, RequestError> {
        Ok(match request.path.as_str() {
            "/scene" => Response::json(&self.live.beginning()),
            "/state" => Response::json(&self.live.status()),
            "/section" => match self.live.section(&words::<SectionWords>(request)?.name) {
                Some(bytes) => Response::new(200, "application/gzip", bytes),
                None => Response::text(404, "the scene has no such part"),
            },
            "/frame" => {
                let asked: LookWords = words(request)?;
                self.drawn(&asked.page, DrawingRequest::Picture(asked.look()?))
            }
            "/depth" => {
                let asked: DepthWords = words(request)?;
                self.drawn(&asked.page, DrawingRequest::Depth(asked.camera.camera()?))
            }
            "/patch" => {
                let PatchWords { page, camera, x, y, water } = words(request)?;
                if !(0.0..=1.0).contains(&water) {
                    return Err(RequestError::Shares("water is"));
                }
                self.drawn(&page, DrawingRequest::Patch { camera: camera.camera()?, x, y, water })
            }
            "/do" => {
                let asked: CommandWords = words(request)?;
                if !self.live.command(&asked.name, asked.share) {
                    return Err(RequestError::Command);
                }
                Response::json(&self.live.status())
            }
            _ => Response::text(404, "there is nothing here"),
        })
    }

    fn drawn(&self, page: &str, wanted: DrawingRequest) -> Response {
        match self.drawing.ask(page, wanted).recv_timeout(PATIENCE) {
            Ok(DrawingAnswer::Picture { bytes, kind, divisor, version }) => {
                let mut response = Response::new(200, kind, bytes);
                response.fields =
                    vec![("X-Divisor", divisor.to_string()), ("X-Version", version.to_string())];
                response
            }
            Ok(DrawingAnswer::Patch(patch)) => {
                Response::json(&json!({ "colors": patch.colors, "depth": patch.depth }))
            }
            Ok(DrawingAnswer::NoPatch(problem)) => Response::json(&json!({ "problem": problem })),
            Ok(DrawingAnswer::Depth(depth)) => Response::json(&json!({ "depth": depth })),
            Ok(DrawingAnswer::Dropped) | Err(_) => Response::new(204, "text/plain", ""),
            Ok(DrawingAnswer::Failed(why)) => Response::text(503, &why),
        }
    }
}

/// Parses a request's body.
fn words<T: serde::de::DeserializeOwned>(request: &HttpRequest) -> Result<T, serde_json::Error> {
    serde_json::from_slice(&request.body)
}
