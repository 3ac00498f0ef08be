//! What the command says when something is wrong, and how it ends: bounds, closed pipes, signals, wrong folders.
//! Nothing here trains; every case takes well under a second.

use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::Duration;

fn command(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_use3d"));
    command.args(arguments);
    for name in ["USE3D_CACHE", "USE3D_MODELS", "USE3D_THREADS", "RUST_LOG"] {
        command.env_remove(name);
    }
    command
}

fn use3d(arguments: &[&str]) -> Output {
    command(arguments).output().expect("the command starts")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Runs each case and asks its exit code and, of what it says on stderr, every given part.
fn check(cases: &[(&[&str], i32, &[&str])]) {
    for (arguments, code, parts) in cases {
        let output = use3d(arguments);
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(*code), "use3d {arguments:?}\n{said}");
        for part in *parts {
            assert!(said.contains(part), "use3d {arguments:?} does not say {part:?}:\n{said}");
        }
    }
}

#[test]
fn numbers_without_a_sensible_meaning_are_refused() {
    check(&[
        (&["--threads", "0", "models"], 2, &["--threads", "1..=1024"]),
        (&["--threads", "99999999", "models"], 2, &["1..=1024"]),
        (&["run", "reef", "--jobs", "0"], 2, &["--jobs", "1..=256"]),
        (&["run", "reef", "--jobs", "99999999"], 2, &["1..=256"]),
        (&["render", "s", "--cameras", "c", "--out", "o", "--frames", "0"], 2, &["--frames", "1..=1000000"]),
        (&["render", "s", "--cameras", "c", "--out", "o", "--frames", "99999999999"], 2, &["1..=1000000"]),
        (&["synth", "pairs", "--out", "p", "--views", "0"], 2, &["pairs is 0", "1 to 100000"]),
    ]);
}

#[test]
fn a_closed_pipe_ends_quietly_and_a_full_disk_does_not() {
    let dir = tempfile::tempdir().unwrap();
    let models = dir.path().to_str().unwrap();
    for arguments in [&["models", "--dir", models][..], &["models", "--json", "--dir", models]] {
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let output = command(arguments).stdout(writer).stderr(Stdio::piped()).output().unwrap();
        assert_eq!((output.status.code(), text(&output.stderr)), (Some(0), String::new()), "{arguments:?}");
    }
    // Nothing to say it to, nothing to panic about.
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let output = command(&["export", "nowhere", "--ply", "x.ply"]).stderr(writer).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
    #[cfg(target_os = "linux")]
    {
        let full = std::fs::File::options().write(true).open("/dev/full").unwrap();
        let output =
            command(&["models", "--dir", models]).stdout(full).stderr(Stdio::piped()).output().unwrap();
        let said = text(&output.stderr);
        assert!(output.status.code() == Some(1) && said.contains("standard output"), "{said}");
    }
}

/// Starts a long command, sends it a signal once `begun` holds, and gives its exit code.
#[cfg(unix)]
fn interrupted(arguments: &[&str], signal: &str, begun: impl Fn() -> bool) -> Option<i32> {
    let mut child = command(arguments).stderr(Stdio::null()).stdout(Stdio::null()).spawn().unwrap();
    while !begun() {
        assert!(child.try_wait().unwrap().is_none(), "use3d {arguments:?} ended before it was interrupted");
        std::thread::sleep(Duration::from_millis(5));
    }
    let sent = Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap();
    assert!(sent.success());
    child.wait().unwrap().code()
}

#[cfg(unix)]
#[test]
fn synthetic_data_that_is_interrupted_leaves_nothing_behind() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let entries = || std::fs::read_dir(dir.path()).unwrap().count();
    let cases = [
        ("pairs", "9999", "-INT"),
        ("pairs", "9999", "-TERM"),
        ("pairs", "9999", "-HUP"),
        ("capture", "99", "-TERM"),
    ];
    for (what, views, signal) in cases {
        let arguments =
            ["-q", "synth", what, "--out", out.to_str().unwrap(), "--views", views, "--size", "32x24"];
        assert_eq!(interrupted(&arguments, signal, || entries() > 0), Some(130), "{what} {signal}");
        assert_eq!(entries(), 0, "{what} {signal}");
    }
}

#[test]
fn folders_of_images_that_cannot_be_scored_are_said_by_name() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name).to_str().unwrap().to_string();
    let picture = use3d_capture::Image::filled(16, 12, 0.5);
    use3d_io_image::write_png(Path::new(&at("a/one.png")), &picture).unwrap();
    use3d_io_image::write_png(Path::new(&at("b/two.png")), &picture).unwrap();
    std::fs::create_dir(at("empty")).unwrap();
    let (a, b, empty, nowhere) = (at("a"), at("b"), at("empty"), at("nowhere"));
    check(&[
        (&["evaluate", "--images", &a, "--reference", &b], 2, &["one", "two", "without its extension"]),
        (&["evaluate", "--images", &nowhere], 2, &["--images", "there is no such folder"]),
        (&["evaluate", "--images", &empty], 2, &["--images", "no images here"]),
        (&["evaluate", "--images", &a, "--reference", &nowhere], 2, &["--reference", "no such folder"]),
        (&["evaluate", "--images", &a], 0, &[]),
        (&["models", "--dir", &nowhere], 2, &["--dir", "there is no such folder"]),
    ]);
}
