//! The payload files of a scene folder. They are written under a temporary name in the same folder and then
//! renamed.

use std::error::Error;
use std::fs::File;
use std::io::{BufReader, BufWriter, Read, Write};
use std::path::Path;

use serde::{Deserialize, Serialize};
use use3d_capture::shown;
use use3d_medium::{MediumKind, MediumModel, Tensor, Tensors};
use use3d_splat::{Gaussians, ply};
use use3d_tensors::{TensorFile, TensorWriter};
use use3d_ubaf::Enhancement;

use crate::SceneError;

pub(crate) const GAUSSIANS: &str = "gaussians.ply";
pub(crate) const MEDIUM: &str = "medium.safetensors";
pub(crate) const ENHANCEMENT: &str = "ubaf.safetensors";
/// Largest size of a tensor file, bytes. A medium or an enhancement has a few hundred kilobytes; a larger
/// file must be something else.
const MOST_TENSOR_BYTES: u64 = 1 << 28;

/// The part of `scene.json` that names the file of the water.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct MediumEntry {
    pub(crate) kind: String,
    #[serde(default)]
    pub(crate) file: Option<String>,
    #[serde(default)]
    pub(crate) top_k: Option<usize>,
    #[serde(default)]
    pub(crate) sh_degree: Option<usize>,
}

/// Adds the path to an error or a message.
pub(crate) fn at<E: Into<Box<dyn Error + Send + Sync>>>(path: &Path) -> impl Fn(E) -> SceneError + '_ {
    move |source| SceneError::File { path: path.into(), source: source.into() }
}

/// The remedy for a scene folder with missing or damaged files.
pub(crate) const AGAIN: &str = "copy the scene folder again, or make it again with `use3d run`";

/// Opens a file that the description names.
fn open(path: &Path) -> Result<File, SceneError> {
    File::open(path).map_err(|error| match (error.kind(), path.parent(), path.file_name()) {
        (std::io::ErrorKind::NotFound, Some(folder), Some(name)) => {
            let name = name.to_string_lossy();
            at(folder)(format!("the scene folder is not complete: {} is missing; {AGAIN}", shown(&name)))
        }
        _ => at(path)(error),
    })
}

/// Reads a whole file, if it is not larger than `most` bytes.
pub(crate) fn read_bounded(path: &Path, most: u64) -> Result<Vec<u8>, SceneError> {
    bounded(File::open(path).map_err(at(path))?, path, most)
}

fn bounded(file: File, path: &Path, most: u64) -> Result<Vec<u8>, SceneError> {
    let mut bytes = Vec::new();
    file.take(most + 1).read_to_end(&mut bytes).map_err(at(path))?;
    if bytes.len() as u64 > most {
        return Err(at(path)(format!("more than {most} bytes; this is not a file of a scene")));
    }
    Ok(bytes)
}

/// Fills a temporary file in the same folder with `write`, syncs it, and renames it to `path`.
fn write_with(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<File>) -> std::io::Result<()>,
) -> Result<(), SceneError> {
    let written = use3d_files::write_atomically(path, |writer| {
        write(writer)?;
        writer.flush()?;
        writer.get_ref().sync_all()
    });
    written.map_err(at(path))
}

fn write_atomic(path: &Path, bytes: &[u8]) -> Result<(), SceneError> {
    write_with(path, |writer| writer.write_all(bytes))
}

/// Writes a value as JSON with a line end after it.
pub(crate) fn write_json(path: &Path, value: &impl Serialize) -> Result<(), SceneError> {
    let text = serde_json::to_string_pretty(value).map_err(at(path))?;
    write_atomic(path, (text + "\n").as_bytes())
}

pub(crate) fn remove(path: &Path) -> Result<(), SceneError> {
    match std::fs::remove_file(path) {
        Err(source) if source.kind() != std::io::ErrorKind::NotFound => Err(at(path)(source)),
        _ => Ok(()),
    }
}

pub(crate) fn read_gaussians(path: &Path) -> Result<Gaussians, SceneError> {
    ply::read(BufReader::new(open(path)?)).map_err(at(path))
}

pub(crate) fn write_gaussians(path: &Path, gaussians: &Gaussians) -> Result<(), SceneError> {
    write_with(path, |writer| ply::write(gaussians, writer))
}

pub(crate) fn read_medium(dir: &Path, entry: &MediumEntry) -> Result<(MediumModel, usize), SceneError> {
    let description = |message: String| at(&dir.join("scene.json"))(message);
    let kind = MediumKind::from_name(&entry.kind).ok_or_else(|| {
        let kinds = MediumKind::names(|_| true);
        description(format!("medium.kind is `{}`; expected {kinds}", shown(&entry.kind)))
    })?;
    let degree = entry.sh_degree.unwrap_or(3);
    if degree > 3 {
        return Err(description(format!("medium.sh_degree is {degree}; expected 0 to 3")));
    }
    if kind == MediumKind::None {
        return Ok((MediumModel::None, degree));
    }
    let name = entry.file.as_ref().ok_or_else(|| {
        description(format!("medium.kind is `{}` but medium.file is missing", shown(&entry.kind)))
    })?;
    let path = dir.join(name);
    let tensors = read_tensors(&path)?;
    let model = MediumModel::from_tensors(kind, entry.top_k.unwrap_or(4), &tensors);
    Ok((model.map_err(at(&path))?, degree))
}

pub(crate) fn write_medium(dir: &Path, medium: &MediumModel) -> Result<(), SceneError> {
    let path = dir.join(MEDIUM);
    let tensors = medium.to_tensors();
    if tensors.is_empty() {
        return remove(&path);
    }
    let mut writer = TensorWriter::new();
    tensors.iter().for_each(|(name, tensor)| writer.f32(name, &tensor.shape, &tensor.values));
    write_atomic(&path, &writer.finish().map_err(at(&path))?)
}

/// Reads every tensor of a file; the medium's kind checks them later.
fn read_tensors(path: &Path) -> Result<Tensors, SceneError> {
    let bytes = bounded(open(path)?, path, MOST_TENSOR_BYTES)?;
    let file = TensorFile::read(&bytes).map_err(at(path))?;
    let mut tensors = Tensors::new();
    for name in file.names() {
        let (shape, values) = file.narrowed(&name).map_err(at(path))?;
        tensors.insert(name, Tensor { shape, values });
    }
    Ok(tensors)
}

pub(crate) fn read_enhancement(path: &Path) -> Result<Enhancement, SceneError> {
    Enhancement::from_safetensors(&bounded(open(path)?, path, MOST_TENSOR_BYTES)?).map_err(at(path))
}

pub(crate) fn write_enhancement(dir: &Path, enhancement: Option<&Enhancement>) -> Result<(), SceneError> {
    let path = dir.join(ENHANCEMENT);
    match enhancement {
        None => remove(&path),
        Some(enhancement) => write_atomic(&path, &enhancement.to_safetensors().map_err(at(&path))?),
    }
}
