//! The page: HTML, style, shaders and scripts, joined with a scene.
//!
//! **One file if possible.** Files below [`ONE_FILE`] open in every browser from a disk; larger ones do not
//! everywhere. So the highest degree of harmonics that still fits is kept, down to none. A scene that is too
//! large even then keeps all harmonics and gets a folder of scripts next to the page, which browsers also
//! read from a disk.
//!
//! **The first picture comes early.** The page begins with the Gaussians that matter most, without the finer
//! harmonics; its script runs before the rest is there. Photographs come last.
//!
//! **No network access.** The page carries a content policy that forbids fetching and sending; scripts and
//! style are allowed by their digests.

use std::collections::BTreeSet;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use use3d_capture::Camera;
use use3d_scene::{Scene, White};
use use3d_ubaf::OUTPUTS;

use crate::evidence::Evidence;
use crate::{Photograph, SavedViews, WebError, enhancement, geometry, scene_file, water};

/// Largest number of bytes of a page that is one file.
pub const ONE_FILE: usize = 32_000_000;
/// Largest number of bytes of a part next to the page.
const PART: usize = 12_000_000;

/// The page's scripts, in the order in which they are joined.
const SCRIPTS: &[&str] = &[
    include_str!("../page/script/vectors.js"),
    include_str!("../page/script/elements.js"),
    include_str!("../page/script/server.js"),
    include_str!("../page/script/data.js"),
    include_str!("../page/script/modes.js"),
    include_str!("../page/script/water.js"),
    include_str!("../page/script/gl.js"),
    include_str!("../page/script/renderer.js"),
    include_str!("../page/script/sorter.js"),
    include_str!("../page/script/software.js"),
    include_str!("../page/script/camera.js"),
    include_str!("../page/script/flight.js"),
    include_str!("../page/script/viewer.js"),
    include_str!("../page/script/navigation.js"),
    include_str!("../page/script/overlay.js"),
    include_str!("../page/script/split.js"),
    include_str!("../page/script/views.js"),
    include_str!("../page/script/shot.js"),
    include_str!("../page/script/path.js"),
    include_str!("../page/script/recorder.js"),
    include_str!("../page/script/measure.js"),
    include_str!("../page/script/saved.js"),
    include_str!("../page/script/white.js"),
    include_str!("../page/script/panel.js"),
    include_str!("../page/script/keys.js"),
    include_str!("../page/script/training.js"),
    include_str!("../page/script/reference.js"),
    include_str!("../page/script/main.js"),
];

/// The shaders by the names that the scripts use.
const SHADERS: &[(&str, &str)] = &[
    ("harmonics", include_str!("../page/shaders/harmonics.glsl")),
    ("screen.vert", include_str!("../page/shaders/screen.vert.glsl")),
    ("water.frag", include_str!("../page/shaders/water.frag.glsl")),
    ("background.frag", include_str!("../page/shaders/background.frag.glsl")),
    ("splat.vert", include_str!("../page/shaders/splat.vert.glsl")),
    ("splat.frag", include_str!("../page/shaders/splat.frag.glsl")),
    ("show.frag", include_str!("../page/shaders/show.frag.glsl")),
];

const FRAME: &str = include_str!("../page/page.html");
const STYLE: &str = include_str!("../page/page.css");
const WORKER: &str =
    concat!(include_str!("../page/script/sort.worker.js"), include_str!("../page/script/draw.worker.js"));

/// The contents of a page.
#[derive(Clone, Debug)]
pub struct Page<'a> {
    /// Its title: the scene's name.
    pub name: &'a str,
    /// The scene.
    pub scene: &'a Scene,
    /// The views that a visitor can move to.
    pub views: Vec<PageView>,
    /// Metres per unit of the COLMAP model, if known; otherwise the value of the saved views is used.
    pub metres_per_unit: Option<f64>,
    /// The views saved from an earlier page.
    pub saved: Option<&'a SavedViews>,
    /// The white balance that it opens with.
    pub white: Option<&'a White>,
}

/// A view of the capture.
#[derive(Clone, Debug)]
pub struct PageView {
    /// Its name.
    pub name: String,
    /// The camera, in the scene's frame.
    pub camera: Camera,
    /// The day when the photograph was taken, if that is known: `2026-11-27`.
    pub day: Option<String>,
    /// True if the view was held out from training.
    pub held_out: bool,
    /// The photograph, if the page shows it.
    pub photograph: Option<Photograph>,
    /// The photograph in the light and colours of the scene, if the page shows it.
    pub enhanced: Option<Photograph>,
}

/// A page that was made.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Written {
    /// The page.
    pub html: String,
    /// Scripts for the folder next to the page, by name; none if the page is one file.
    pub parts: Vec<(String, String)>,
    /// The degree up to which harmonics were kept.
    pub degree: usize,
}

impl Written {
    /// Bytes of all files together.
    pub fn bytes(&self) -> usize {
        self.html.len() + self.parts.iter().map(|(_, text)| text.len()).sum::<usize>()
    }
}

/// A scene's data, for a server that sends it to the page section by section.
#[derive(Clone, Debug)]
pub struct PageData {
    /// The page's data about the scene apart from the Gaussians.
    pub header: Value,
    /// The sections from which the page draws, by name, each compressed by gzip.
    pub sections: Vec<(&'static str, Vec<u8>)>,
}

/// The page without a scene: it requests one from the server that it came from.
#[derive(Clone, Debug)]
pub struct Served {
    /// The page.
    pub html: String,
    /// Its content policy, which the server must send with it.
    pub policy: String,
}

/// The page's data about a scene whose pictures are drawn elsewhere.
pub fn header(page: &Page<'_>) -> Value {
    let mut header = entries(page);
    header["sections"] = Value::Array(Vec::new());
    header["photographs"] = photographs(page);
    header
}

/// The bytes of a scene's Gaussians and water, for the sections of a page.
struct Contents<'a> {
    scene: &'a Scene,
    grades: Option<Vec<[f32; OUTPUTS]>>,
    evidence: Option<Evidence>,
    /// The order of the Gaussians, and the number of those with which the page begins.
    order: Vec<u32>,
    first: usize,
}

impl<'a> Contents<'a> {
    fn of(page: &Page<'a>) -> Result<Self, WebError> {
        let scene = page.scene;
        if scene.gaussians.is_empty() {
            return Err(WebError::Empty);
        }
        let cameras: Vec<Camera> = page.views.iter().filter(|v| !v.held_out).map(|v| v.camera).collect();
        let evidence = Evidence::of(scene, &cameras);
        let (order, first) = geometry::file_order(&scene.gaussians, |i| match &evidence {
            Some(evidence) => evidence.weights[i],
            None => geometry::size(&scene.gaussians, i),
        });
        Ok(Self { scene, grades: enhancement::grades(scene), evidence, order, first })
    }

    /// The geometry of the Gaussians with which the page begins, or of the others.
    fn geometry(&self, first: bool) -> Vec<u8> {
        let order = if first { &self.order[..self.first] } else { &self.order[self.first..] };
        scene_file::geometry(self.scene, self.grades.as_deref(), self.evidence.as_ref(), order)
    }

    fn harmonics(&self, degree: usize) -> Vec<u8> {
        if degree == 0 { Vec::new() } else { scene_file::harmonics(self.scene, degree, &self.order) }
    }

    /// Adds what the page needs to read the sections, with harmonics up to `degree`.
    fn describe(&self, header: &mut Value, degree: usize) {
        header["first"] = self.first.into();
        header["evidence"] = self.evidence.is_some().into();
        header["degree"] = degree.into();
        header["harmonicBytes"] = scene_file::harmonic_bytes(degree).into();
    }
}

/// The photographs of each view: as taken, and in the light and colours of the scene.
fn photographs(page: &Page<'_>) -> Value {
    let address = |photograph: &Option<Photograph>| photograph.as_ref().map(|p| p.address.clone());
    page.views.iter().map(|view| json!([address(&view.photograph), address(&view.enhanced)])).collect()
}

/// All data from which the page draws a scene, with harmonics of every degree.
///
/// # Errors
/// Fails for a scene without Gaussians.
pub fn data(page: &Page<'_>) -> Result<PageData, WebError> {
    let (contents, degree) = (Contents::of(page)?, page.scene.gaussians.sh_degree.min(3));
    let sections = [
        ("geometry", contents.geometry(true)),
        ("cube", water::cube(page.scene).unwrap_or_default()),
        ("rest", contents.geometry(false)),
        ("harmonics", contents.harmonics(degree)),
        ("photographs", photographs(page).to_string().into_bytes()),
    ];
    let sections: Vec<_> = sections.into_iter().filter(|(_, bytes)| !bytes.is_empty()).collect();
    let mut header = entries(page);
    contents.describe(&mut header, degree);
    header["sections"] = sections.iter().map(|(name, _)| json!({ "name": name, "parts": 1 })).collect();
    let sections = sections.into_iter().map(|(name, bytes)| Ok((name, scene_file::packed(&bytes)?)));
    Ok(PageData { header, sections: sections.collect::<Result<_, WebError>>()? })
}

/// The page that requests its scene from the server.
pub fn served() -> Served {
    let (html, policy) = html("3D-USE", &Value::Null, ["", ""], SceneSource::Server);
    Served { html, policy }
}

/// Makes the page. `folder` is the name of the folder for its parts, if it needs one: a plain name, relative
/// to the page.
///
/// # Errors
/// Fails for a scene without Gaussians.
pub fn write(page: &Page<'_>, folder: &str) -> Result<Written, WebError> {
    write_below(page, folder, ONE_FILE)
}

/// Like [`write`], with another size limit for one file.
fn write_below(page: &Page<'_>, folder: &str, most: usize) -> Result<Written, WebError> {
    let (contents, full) = (Contents::of(page)?, page.scene.gaussians.sh_degree.min(3));
    let pack = |bytes: Vec<u8>| match bytes.is_empty() {
        true => Ok(String::new()),
        false => Ok::<_, WebError>(STANDARD.encode(scene_file::packed(&bytes)?)),
    };
    let harmonics = |degree: usize| pack(contents.harmonics(degree));
    let ((geometry, rest), all) =
        rayon::join(|| (pack(contents.geometry(true)), pack(contents.geometry(false))), || harmonics(full));
    let (geometry, rest, all) = (geometry?, rest?, all?);
    let cube = pack(water::cube(page.scene).unwrap_or_default())?;
    let mut header = entries(page);
    let photographs = format!(
        "<script type=\"application/json\" id=\"photographs\">{}</script>\n",
        photographs(page).to_string().replace('<', "\\u003c")
    );

    // The page without its parts, and room for their elements.
    let frame = html(page.name, &header, ["", &photographs], SceneSource::Page).0.len();
    let fixed = frame + geometry.len() + rest.len() + cube.len() + 1000;
    let mut degree = full;
    let mut kept = all.clone();
    while degree > 0 && fixed + kept.len() > most {
        degree -= 1;
        kept = harmonics(degree)?;
    }
    let one_file = fixed + kept.len() <= most;
    if !one_file {
        (degree, kept) = (full, all);
    }
    contents.describe(&mut header, degree);
    // The script of the page stands between the first two sections and the others.
    let sections = [("geometry", geometry), ("cube", cube), ("rest", rest), ("harmonics", kept)];
    let (mut parts, mut entries, mut elements) = (Vec::new(), Vec::new(), [String::new(), String::new()]);
    for (i, (name, text)) in sections.iter().enumerate().filter(|(_, (_, text))| !text.is_empty()) {
        let elements = &mut elements[usize::from(i > 1)];
        // Base64 uses groups of four characters, so every piece stands for whole bytes.
        let pieces: Vec<&str> = if one_file { vec![text] } else { pieces(text, PART) };
        entries.push(json!({ "name": name, "parts": pieces.len() }));
        for piece in pieces {
            if one_file {
                elements.push_str(&format!("<script type=\"text/plain\" data-part>{piece}</script>\n"));
            } else {
                let file = format!("part-{}.js", parts.len());
                elements
                    .push_str(&format!("<script src=\"{}/{file}\"></script>\n", escaped(&address(folder))));
                parts.push((file, format!("(window.use3dParts ||= []).push(\"{piece}\");\n")));
            }
        }
    }
    elements[1].push_str(&photographs);
    header["sections"] = entries.into();
    let source = if one_file { SceneSource::Page } else { SceneSource::Beside };
    let html = html(page.name, &header, elements.each_ref().map(String::as_str), source).0;
    Ok(Written { html, parts, degree })
}

/// `text` in pieces of at most `most` bytes, a multiple of four.
fn pieces(text: &str, most: usize) -> Vec<&str> {
    (0..text.len()).step_by(most).map(|at| &text[at..(at + most).min(text.len())]).collect()
}

/// A digest of everything in a page except the scene. It distinguishes two programs that make different pages
/// of the same scene.
pub fn digest() -> String {
    let (html, _) = html("", &Value::Null, ["", ""], SceneSource::Page);
    Sha256::digest(html.as_bytes()).iter().map(|byte| format!("{byte:02x}")).collect()
}

/// The page's data about the scene apart from the Gaussians.
fn entries(page: &Page<'_>) -> Value {
    let scene = page.scene;
    let [low, high] = geometry::bounds(&scene.gaussians);
    let views: Vec<Value> = page
        .views
        .iter()
        .map(|view| {
            let (k, pose) = (&view.camera.intrinsics, &view.camera.pose);
            let rows: [[f64; 3]; 3] = std::array::from_fn(|r| pose.rotation.row(r).to_array());
            json!({
                "name": view.name,
                "eye": pose.center().to_array(),
                "rotation": rows,
                "lens": [k.fx, k.fy, k.cx, k.cy],
                "width": k.width,
                "height": k.height,
                "heldOut": view.held_out,
                "focus": geometry::focus(&scene.gaussians, &view.camera),
            })
        })
        .collect();
    let frame = &scene.frame;
    json!({
        "format": "3d-use web scene",
        "version": 1,
        "name": page.name,
        "count": scene.gaussians.len(),
        "frame": {
            "scale": frame.scale,
            "rotation": frame.rotation.transpose().to_cols_array(),
            "translation": frame.translation.to_array(),
        },
        "bounds": { "low": low, "high": high },
        "metresPerUnit": page.metres_per_unit.or_else(|| page.saved?.metres_per_unit),
        "saved": page.saved,
        "white": page.white,
        "medium": water::entry(scene),
        "enhancement": enhancement::entry(scene),
        "days": page.views.iter().filter_map(|view| view.day.as_ref()).collect::<BTreeSet<_>>(),
        "cameras": views,
    })
}

/// The place from which a page gets its scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum SceneSource {
    Page,
    Beside,
    Server,
}

/// The text of the whole page, and its content policy; `parts` are the elements before and after its script.
fn html(name: &str, header: &Value, parts: [&str; 2], source: SceneSource) -> (String, String) {
    let script = SCRIPTS.join("\n");
    let script_element = format!("\n(() => {{\n'use strict';\n{script}\n}})();\n");
    let style_element = format!("\n{STYLE}\n");
    let digest = |text: &str| format!("'sha256-{}'", STANDARD.encode(Sha256::digest(text.as_bytes())));
    // The parts next to a page come from the same place as the page, a disk or a host.
    let (beside, connect) = match source {
        SceneSource::Page => ("", ""),
        SceneSource::Beside => (" 'self' file:", ""),
        SceneSource::Server => ("", "connect-src 'self'; "),
    };
    let policy = format!(
        "default-src 'none'; script-src {}{beside}; style-src {}; worker-src blob:; img-src data: blob:; media-src blob:; \
         {connect}base-uri 'none'; form-action 'none'",
        digest(&script_element),
        digest(&style_element),
    );
    let shaders: Vec<String> = SHADERS
        .iter()
        .map(|(id, text)| format!("<script type=\"x-shader/glsl\" id=\"{id}\">\n{}\n</script>", text.trim()))
        .collect();
    // `<` would end the element that contains the JSON.
    let header = header.to_string().replace('<', "\\u003c");
    let program = format!("3D-USE {}", env!("CARGO_PKG_VERSION"));
    let fill = [
        ("{{policy}}", policy.as_str()),
        ("{{program}}", &program),
        ("\n{{style}}\n", &style_element),
        ("{{shaders}}", &shaders.join("\n")),
        ("{{worker}}", WORKER),
        ("{{header}}", &header),
        ("{{parts}}", parts[0]),
        ("{{rest}}", parts[1]),
        ("\n(() => {\n'use strict';\n{{script}}\n})();\n", &script_element),
        ("{{title}}", &escaped(name)),
    ];
    (filled(FRAME, &fill), policy.clone())
}

/// `frame` with every mark replaced. Marks inside the inserted texts are not replaced.
fn filled(frame: &str, fill: &[(&str, &str)]) -> String {
    let mut out = String::with_capacity(frame.len() + fill.iter().map(|(_, text)| text.len()).sum::<usize>());
    let mut rest = frame;
    loop {
        let next =
            fill.iter().filter_map(|(mark, text)| Some((rest.find(mark)?, mark, text))).min_by_key(|f| f.0);
        let Some((at, mark, text)) = next else { break };
        out.push_str(&rest[..at]);
        out.push_str(text);
        rest = &rest[at + mark.len()..];
    }
    out + rest
}

/// Text escaped for an element or an attribute.
fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// The name of a file or folder, escaped as a part of a URL.
pub fn address(name: &str) -> String {
    let plain = |b: u8| b.is_ascii_alphanumeric() || b"-._~".contains(&b);
    name.bytes().map(|b| if plain(b) { char::from(b).to_string() } else { format!("%{b:02X}") }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_capture::Frame;
    use use3d_medium::MediumModel;
    use use3d_numerics::random::{Purpose, Stream};
    use use3d_splat::Gaussians;

    fn scene(count: usize) -> Scene {
        let draw = Stream::new(3, Purpose::new("page"), 0);
        let noise = |i: usize| draw.uniform(i as u64) as f32;
        let gaussians = Gaussians {
            sh_degree: 3,
            means: (0..count).map(|i| std::array::from_fn(|a| noise(3 * i + a))).collect(),
            log_scales: vec![[-3.0; 3]; count],
            quaternions: vec![[1.0, 0.0, 0.0, 0.0]; count],
            opacity_logits: vec![1.0; count],
            sh: (0..count)
                .map(|i| std::array::from_fn(|k| std::array::from_fn(|c| noise(48 * i + 3 * k + c))))
                .collect(),
        };
        let medium = MediumModel::None;
        Scene { gaussians, frame: Frame::IDENTITY, medium, medium_degree: 0, enhancement: None }
    }

    #[test]
    fn a_large_scene_gives_up_harmonics_and_a_larger_one_gets_a_folder() {
        let scene = scene(3000);
        let page = Page {
            name: "a <b> & \"c\"",
            scene: &scene,
            views: Vec::new(),
            metres_per_unit: None,
            saved: None,
            white: None,
        };
        let whole = write(&page, "a b").unwrap();
        assert_eq!((whole.degree, whole.parts.len()), (3, 0));
        assert!(whole.html.contains("a &lt;b&gt; &amp; &quot;c&quot;") && !whole.html.contains("<b>"));
        let less = write_below(&page, "a b", whole.html.len() - 20_000).unwrap();
        assert!(less.degree < 3 && less.parts.is_empty() && less.bytes() < whole.bytes(), "{}", less.degree);
        let folder = write_below(&page, "a b", 1000).unwrap();
        assert_eq!(folder.degree, 3);
        assert!(folder.html.contains("src=\"a%20b/part-0.js\"") && folder.parts.len() == 2);
    }

    #[test]
    fn nothing_is_left_to_fill_in_and_nothing_names_another_host() {
        let scene = scene(10);
        let page = Page {
            name: "{{parts}}",
            scene: &scene,
            views: Vec::new(),
            metres_per_unit: None,
            saved: None,
            white: None,
        };
        let html = write(&page, "x").unwrap().html;
        assert_eq!(html.matches("{{").count(), html.matches("{{parts}}").count());
        let named = html.matches("http").count() - html.matches("http-equiv").count();
        assert_eq!(named, html.matches("xmlns='http://www.w3.org/2000/svg'").count());
        assert!(html.contains("default-src 'none'"));
    }
}
