//! A folder with photographs, and a script in the place of `colmap`.

use std::os::unix::fs::PermissionsExt;
use std::path::PathBuf;

use use3d_capture::{FileName, Raster};
use use3d_io_colmap::{Keypoint, LensModel, Model, ModelCamera, ModelImage, ModelPoint, write_model_binary};
use use3d_numerics::math::sin;
use use3d_prepare::{Finder, PrepareParams, Programs};

use super::{Attempt, attempt};

/// A folder with ten photographs, a script as `colmap`, and the models that the script finds.
pub(crate) struct Place {
    pub(crate) dir: tempfile::TempDir,
}

/// The script in the place of `colmap`.
pub(crate) const SCRIPT: &str = r#"#!/bin/sh
here=$(dirname "$0")
case "$1" in help) echo "COLMAP 9.9 -- a script"; exit 0;; esac
if [ "$2" = -h ]; then echo "--SiftExtraction.use_gpu --SiftMatching.num_threads"; exit 0; fi
echo "$@" >> "$here/calls"
# Like COLMAP, the mapper also writes into its database.
[ "$1" = mapper ] && echo read >> "$3"
if [ -e "$here/fail-$1" ]; then echo "the disk is on fire" >&2; exit 3; fi
case "$1" in
feature_extractor) echo features > features.db ;;
*_matcher) cat features.db > /dev/null && echo matches >> matches.db ;;
mapper) case "$*" in *learned.db*) kind=learned; to=learned-models;; *usual*) kind=matches; to=models-usual-lens;;
    *) kind=matches; to=models;; esac
  [ "$(wc -l < $kind.db)" = 2 ] || exit 9
  for model in "$here"/$to/*; do [ -d "$model" ] && cp -r "$model" $to/; done
  ls $to/* > /dev/null 2>&1 || exit 1 ;;
esac
"#;

impl Place {
    pub(crate) fn new() -> Self {
        let place = Self { dir: tempfile::tempdir().unwrap() };
        let script = place.at("colmap");
        std::fs::write(&script, SCRIPT).unwrap();
        std::fs::set_permissions(&script, std::fs::Permissions::from_mode(0o755)).unwrap();
        std::fs::create_dir_all(place.at("photos")).unwrap();
        std::fs::create_dir_all(place.at("models")).unwrap();
        for i in 0..10u8 {
            let image = Raster::<u8, 3>::filled(16, 12, 20 * i);
            use3d_io_image::write_png8(&place.at("photos").join(name(i.into()).as_str()), &image).unwrap();
        }
        place
    }

    pub(crate) fn at(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    /// The script finds these images in its model of that number, with this reprojection error.
    pub(crate) fn found(&self, number: usize, images: impl Iterator<Item = usize>, error: f64) {
        self.found_as(number, images.map(|i| (i, name(i))), error);
    }

    /// The same with learned keypoints.
    pub(crate) fn found_learned(&self, number: usize, images: impl Iterator<Item = usize>, error: f64) {
        self.found_in("learned-models", number, images.map(|i| (i, name(i))), error);
    }

    /// The same for images with names of their own.
    pub(crate) fn found_as(
        &self,
        number: usize,
        images: impl Iterator<Item = (usize, FileName)>,
        error: f64,
    ) {
        self.found_in("models", number, images, error);
    }

    /// The script finds all ten images on a straight swim with this focal length, which then is in no way
    /// determined; `folder` has the models of one call of the mapper.
    pub(crate) fn found_straight(&self, folder: &str, focal: f64, error: f64) {
        let parameters = vec![focal, 8.0, 6.0, 0.0];
        let camera = ModelCamera { id: 1, model: LensModel::SimpleRadial, width: 16, height: 12, parameters };
        let position = |i: u64| {
            let i = i as f64;
            [8.0 * sin(1.3 * i), 3.0 * sin(2.1 * i), 8.0 + sin(0.7 * i)]
        };
        let keypoints: Vec<Keypoint> = (0..80).map(|point| Keypoint { x: 8.0, y: 6.0, point }).collect();
        let image = |i: usize| ModelImage {
            id: i as u32 + 1,
            name: name(i),
            camera: 1,
            quaternion: [1.0, 0.0, 0.0, 0.0],
            translation: [2.0 - 0.5 * i as f64, 0.0, 0.0],
            keypoints: keypoints.clone(),
        };
        let images: Vec<ModelImage> = (0..10).map(image).collect();
        let track: Vec<(u32, u32)> = (0..10).map(|i| (i + 1, 0)).collect();
        let of = |id: u64| {
            let track = track.iter().map(|(image, _)| (*image, id as u32)).collect();
            ModelPoint { id, position: position(id), color: [9; 3], error, track }
        };
        let points = (0..80).map(of).collect();
        let folder = self.at(folder).join("0");
        std::fs::create_dir_all(&folder).unwrap();
        write_model_binary(&folder, &Model { cameras: vec![camera], images, points }).unwrap();
    }

    fn found_in(
        &self,
        folder: &str,
        number: usize,
        images: impl Iterator<Item = (usize, FileName)>,
        error: f64,
    ) {
        let camera = ModelCamera {
            id: 1,
            model: LensModel::SimpleRadial,
            width: 16,
            height: 12,
            parameters: vec![20.0, 8.0, 6.0, 0.0],
        };
        let images: Vec<ModelImage> = images
            .map(|(i, name)| ModelImage {
                id: i as u32 + 1,
                name,
                camera: 1,
                quaternion: [1.0, 0.0, 0.0, 0.0],
                translation: [i as f64, 0.0, 4.0],
                keypoints: vec![Keypoint { x: 8.0, y: 6.0, point: 1 }],
            })
            .collect();
        let track = images.iter().map(|image| (image.id, 0)).collect();
        let point = ModelPoint { id: 1, position: [0.0, 0.0, 1.0], color: [9, 9, 9], error, track };
        let folder = self.at(folder).join(number.to_string());
        std::fs::create_dir_all(&folder).unwrap();
        write_model_binary(&folder, &Model { cameras: vec![camera], images, points: vec![point] }).unwrap();
    }

    pub(crate) fn attempt(&self, params: &PrepareParams) -> Attempt {
        // Without a package of networks, whatever this machine has.
        let (colmap, python) = (self.at("colmap"), self.at("python"));
        let programs = Programs { colmap, python, finder: Finder::Colmap, ..Programs::default() };
        attempt(&[self.at("photos")], params, &programs, &self.at("reef"))
    }

    /// The verbs that were called since the last look.
    pub(crate) fn calls(&self) -> Vec<String> {
        let text = std::fs::read_to_string(self.at("calls")).unwrap_or_default();
        let _ = std::fs::remove_file(self.at("calls"));
        text.lines().map(|l| l.split(' ').next().unwrap().to_string()).collect()
    }
}

/// The name of a photograph.
pub(crate) fn name(i: usize) -> FileName {
    FileName::new(&format!("p_{i:02}.png")).unwrap()
}
