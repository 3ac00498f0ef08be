//! The XMP files beside photographs. A value is an attribute of the description or an element in it.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use glam::{DMat3, DVec3};
use roxmltree::{Document, Node};
use use3d_capture::{FileName, Pose, shown};
use use3d_survey::{ReadError, RotationFault, check_rotation, first_bytes, read_at_most, text, unread};

use crate::registration::{RegisteredShot, Registration, ShareLens};

type Result<T> = std::result::Result<T, ReadError>;

/// The namespace of RealityScan's values.
const NAMESPACE: &str = "http://www.capturingreality.com/ns/xcr/1.1#";
/// The largest file that is read, bytes.
const LARGEST: u64 = 1 << 20;
/// The newest version whose values are known.
const NEWEST: f64 = 4.0;
/// Width of the film that the focal length is stated for, millimetres.
const FILM: f64 = 36.0;
/// A rotation may be off orthonormal by this.
const ORTHONORMAL: f64 = 1e-4;

/// The values that are read, and others that change nothing here.
const KNOWN: &str = "Version Rotation Position Coordinates ComponentId FocalLength35mm Skew AspectRatio PrincipalPointU \
    PrincipalPointV DistortionModel DistortionCoeficients PosePrior CalibrationPrior CalibrationGroup \
    DistortionGroup LensGroup Rig RigInstance RigPoseIndex InTexturing InColoring InMeshing";

/// The bytes of an XMP file.
#[derive(Clone, Debug)]
pub struct Sidecar {
    /// The name of its photograph, without the extension.
    pub name: FileName,
    /// Its place, for messages.
    pub path: PathBuf,
    /// Its content.
    pub bytes: Vec<u8>,
}

/// Reads the bytes of an XMP file.
///
/// # Errors
/// A file that cannot be read.
pub fn read_sidecar(name: FileName, path: &Path) -> Result<Sidecar> {
    let bytes = read_at_most(path, LARGEST, "it is no XMP file of RealityScan; remove it")?;
    Ok(Sidecar { name, path: path.to_path_buf(), bytes })
}

/// True if a file's first bytes have RealityScan's namespace.
pub fn is_sidecar(path: &Path) -> bool {
    first_bytes(path, 1 << 16).is_some_and(|head| String::from_utf8_lossy(&head).contains(NAMESPACE))
}

/// The values of one file.
struct Description<'a> {
    node: Node<'a, 'a>,
    path: &'a Path,
}

impl Description<'_> {
    fn fail<T>(&self, name: &str, reason: impl Into<String>) -> Result<T> {
        Err(ReadError::broken(self.path, format!("xcr:{name}"), reason))
    }

    fn text(&self, name: &str) -> Option<&str> {
        let attribute = self.node.attribute((NAMESPACE, name));
        let element = || self.node.children().find(|n| n.has_tag_name((NAMESPACE, name)))?.text();
        attribute.or_else(element).map(str::trim).filter(|text| !text.is_empty())
    }

    /// The names of all values.
    fn names(&self) -> impl Iterator<Item = &str> {
        let attributes =
            self.node.attributes().filter(|a| a.namespace() == Some(NAMESPACE)).map(|a| a.name());
        let elements = self.node.children().map(|n| n.tag_name());
        attributes.chain(elements.filter(|name| name.namespace() == Some(NAMESPACE)).map(|name| name.name()))
    }

    /// Exactly `N` numbers; `None` if the value is not there.
    fn numbers<const N: usize>(&self, name: &str) -> Result<Option<[f64; N]>> {
        let Some(text) = self.text(name) else { return Ok(None) };
        let words: Option<Vec<f64>> = text
            .split_ascii_whitespace()
            .take(N + 1)
            .map(|word| word.parse::<f64>().ok().filter(|v| v.is_finite()))
            .collect();
        if let Some(numbers) = words.and_then(|words| words.try_into().ok()) {
            return Ok(Some(numbers));
        }
        let count = if N == 1 { "one finite number".into() } else { format!("{N} finite numbers") };
        let text: String = shown(text).chars().take(80).collect();
        self.fail(name, format!("it is {text:?}; expected {count}: export the XMP files again"))
    }

    fn number(&self, name: &str, default: f64) -> Result<f64> {
        Ok(self.numbers::<1>(name)?.map_or(default, |[v]| v))
    }

    /// World to camera; `None` if the file has a calibration alone.
    fn pose(&self) -> Result<Option<Pose>> {
        let rotation = self.numbers::<9>("Rotation")?;
        let (Some(rotation), Some(position)) = (rotation, self.numbers::<3>("Position")?) else {
            return Ok(None);
        };
        let rotation = DMat3::from_cols_array(&rotation).transpose();
        match check_rotation(&rotation, ORTHONORMAL) {
            Ok(()) => Ok(Some(Pose::from_center(rotation, DVec3::from_array(position)))),
            Err(RotationFault::NotOrthonormal(off)) => self.fail(
                "Rotation",
                format!("it is off orthonormal by {off:.1e}; expected a rotation: export the XMP files again"),
            ),
            Err(RotationFault::Mirrored) => self.fail(
                "Rotation",
                "its axes are mirrored (the determinant is -1); expected a right-handed rotation: export the XMP \
                 files again without changing axes",
            ),
        }
    }

    fn lens(&self) -> Result<ShareLens> {
        let f = self.number("FocalLength35mm", 0.0)?;
        if f <= 0.0 {
            let reason =
                format!("it is {f}; expected millimetres above 0: align the photographs and export again");
            return self.fail("FocalLength35mm", reason);
        }
        for (name, usual) in [("Skew", 0.0), ("AspectRatio", 1.0)] {
            let value = self.number(name, usual)?;
            if (value - usual).abs() > 1e-9 {
                let reason = format!(
                    "it is {value}; expected {usual}: choose a distortion model without K+ in the alignment \
                     settings, align again, and export again"
                );
                return self.fail(name, reason);
            }
        }
        let bends = self.numbers::<6>("DistortionCoeficients")?.unwrap_or_default();
        let (radial, tangential) = match self.text("DistortionModel").unwrap_or("perspective") {
            // Without distortion, what stands there does not count.
            "perspective" => ([0.0; 4], [0.0; 2]),
            "brown3" | "brown4" | "brown3t2" | "brown4t2" => {
                ([bends[0], bends[1], bends[2], bends[3]], [bends[4], bends[5]])
            }
            other if bends == [0.0; 6] && other == "division" => ([0.0; 4], [0.0; 2]),
            other => {
                let reason = format!(
                    "it is {:?}; expected perspective, brown3, brown4, brown3t2 or brown4t2: choose Brown3 in the \
                     alignment settings, align again, and export again, or export in COLMAP's format",
                    shown(other)
                );
                return self.fail("DistortionModel", reason);
            }
        };
        let principal = [self.number("PrincipalPointU", 0.0)?, self.number("PrincipalPointV", 0.0)?];
        Ok(ShareLens { focal: f / FILM, principal, radial, tangential })
    }
}

/// Reads the XMP files of a project. Of several components the one with the most cameras is used.
///
/// # Errors
/// A file that holds something that cannot be used, and files that have no pose at all; the message names
/// the file and the value. `folder` is for the message about all of them.
pub fn parse_sidecars(sidecars: &[Sidecar], folder: &Path) -> Result<Registration> {
    let mut components: BTreeMap<String, Vec<RegisteredShot>> = BTreeMap::new();
    let (mut without, mut frames) = (0usize, BTreeMap::<String, usize>::new());
    let mut fields: BTreeSet<String> = BTreeSet::new();
    for Sidecar { name, path, bytes } in sidecars {
        let text =
            text(bytes).map_err(|(line, reason)| ReadError::broken(path, format!("line {line}"), reason))?;
        let document = Document::parse(text).map_err(|e| {
            let reason = format!("it is damaged or cut short ({e}); export the XMP files again");
            ReadError::broken(path, "XML", reason)
        })?;
        let ours = |node: &Node<'_, '_>| {
            node.tag_name().name() == "Description"
                && (node.attributes().any(|a| a.namespace() == Some(NAMESPACE))
                    || node.children().any(|n| n.tag_name().namespace() == Some(NAMESPACE)))
        };
        let Some(node) = document.descendants().find(ours) else {
            without += 1;
            continue;
        };
        let description = Description { node, path };
        fields.extend(description.names().map(String::from));
        let version = description.number("Version", 1.0)?;
        if version > NEWEST {
            let reason = format!(
                "it is {version}; expected 1 to {NEWEST}: export the registration as \"Internal/External camera \
                 parameters\" (CSV), or in COLMAP's format"
            );
            return description.fail("Version", reason);
        }
        let Some(pose) = description.pose()? else {
            without += 1;
            continue;
        };
        let frame = description.text("Coordinates").unwrap_or("absolute").to_string();
        if !["absolute", "relative"].contains(&frame.as_str()) {
            let reason = format!(
                "it is {:?}, so poses count from a rig; expected absolute: export the XMP files again without rigs",
                shown(&frame)
            );
            return description.fail("Coordinates", reason);
        }
        *frames.entry(frame).or_default() += 1;
        let shot = RegisteredShot { name: name.clone(), pose, lens: description.lens()? };
        let component = description.text("ComponentId").unwrap_or_default().to_string();
        components.entry(component).or_default().push(shot);
    }
    if frames.len() > 1 {
        let list: Vec<String> = frames.iter().map(|(name, count)| format!("{count} {name}")).collect();
        let reason = format!(
            "the files have different coordinates ({}); expected one kind: remove all XMP files and export them again",
            list.join(", ")
        );
        return Err(ReadError::broken(folder, "xcr:Coordinates", reason));
    }
    let most = components.values().map(Vec::len).max().unwrap_or(0);
    let Some(used) = components.values().position(|shots| shots.len() == most) else {
        let reason = format!(
            "none of {} XMP files has a pose; align the photographs, then export the metadata (XMP) with camera poses",
            sidecars.len()
        );
        return Err(ReadError::broken(folder, "xcr:Position", reason));
    };
    let (mut used_shots, mut notes) = (Vec::new(), Vec::new());
    notes.extend(unread("the XMP files", fields.iter().map(String::as_str), KNOWN));
    if without > 0 {
        notes.push(format!("{without} XMP files have no pose: their photographs are not aligned"));
    }
    for (i, shots) in components.into_values().enumerate() {
        if i == used {
            used_shots = shots;
        } else {
            notes.push(format!("{} cameras belong to another component and are not used", shots.len()));
        }
    }
    Ok(Registration { shots: used_shots, notes })
}
