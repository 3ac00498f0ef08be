//! Tests that watching a training does not change it, and that a watched training can be paused, stopped,
//! followed by its files, and viewed when it is done.

mod tiny;
mod viewer;

use std::io::{BufRead, BufReader};
use std::net::TcpListener;
use std::path::Path;
use std::process::{Child, Command, Stdio};

use serde_json::json;
use tiny::{Place, command, files};
use viewer::{Ended, Viewer};

fn reconstruct(capture: &str, out: &str) -> Command {
    let mut command = command();
    command.args(["-q", "reconstruct", capture, "--out", out, "--set", "iterations=15"]);
    command
}

fn watched(capture: &str, out: &str) -> Child {
    let mut command = reconstruct(capture, out);
    command.args(["--view", "--no-open"]).stderr(Stdio::piped());
    command.spawn().expect("the command starts")
}

fn same(a: &str, b: &str) {
    let (a, b) = (files(Path::new(a)), files(Path::new(b)));
    assert!(a.keys().eq(b.keys()), "{:?} {:?}", a.keys(), b.keys());
    for (name, bytes) in &a {
        assert!(*bytes == b[name], "{} differs", name.display());
    }
}

#[test]
fn a_watched_training_gives_the_same_bytes_however_it_is_watched() {
    let place = Place::new();
    let capture = place.at("tiny");
    let [alone, seen, stopped] = ["alone/scene", "seen/scene", "stopped/scene"].map(|name| place.at(name));
    assert!(reconstruct(&capture, &alone).status().expect("the command starts").success());

    // Moved, paused and viewed in every way from the first step to the last.
    let mut child = watched(&capture, &seen);
    let viewer = Viewer::of(child.stderr.take().expect("a pipe"));
    viewer.command("pause").expect("paused before it begins");
    let header = viewer.header();
    let paused = viewer.json("/state", &json!({})).expect("an answer");
    assert!(paused["paused"] == true && paused["step"] == 1, "{paused}");
    assert_eq!(viewer.json("/state", &json!({})).expect("an answer")["step"], 1, "it waits");
    assert_eq!(header["cameras"].as_array().map(Vec::len), Some(9));
    assert_eq!(header["cameras"][0]["heldOut"], true);
    let photograph = header["photographs"][0][0].as_str();
    assert!(photograph.is_some_and(|photograph| photograph.starts_with("data:image/jpeg")));
    assert!((0..8).all(|i| viewer.draw(&header, i) == Some(200)));
    let (mut i, mut steps) = (8, Vec::new());
    while viewer.command("resume").is_some() {
        viewer.draw(&header, i);
        let status = viewer.command("pause");
        steps.extend(status.as_ref().and_then(|s| s["step"].as_u64()));
        viewer.draw(&header, i + 1);
        i += 2;
    }
    assert!(child.wait().expect("it ends").success());
    steps.dedup();
    assert!(steps.len() > 1, "it was watched at several steps: {steps:?}");
    same(&alone, &seen);

    // Stopped from the page, followed by its checkpoint, then resumed.
    let mut child = watched(&capture, &stopped);
    let viewer = Viewer::of(child.stderr.take().expect("a pipe"));
    viewer.command("pause").expect("paused");
    viewer.header();
    viewer.command("stop").expect("stopped");
    assert_eq!(child.wait().expect("it ends").code(), Some(130));
    let mut follow = command();
    follow
        .args(["-q", "view", "--follow", &stopped, "--cameras", &capture, "--no-open"])
        .stdout(Stdio::piped());
    let mut follow = Ended(follow.spawn().expect("the command starts"));
    let follower = Viewer::of(follow.0.stdout.take().expect("a pipe"));
    let header = follower.header();
    assert_eq!(header["name"], "stopped");
    assert_eq!(follower.draw(&header, 0), Some(200));
    let at = |viewer: &Viewer| viewer.json("/state", &json!({})).expect("an answer")["shownStep"].as_u64();
    assert_eq!(at(&follower), Some(1));
    assert!(
        follower.command("stop").is_none(),
        "nothing to stop: {:?}",
        follower.ask("/do", &json!({ "name": "stop" }))
    );
    assert!(reconstruct(&capture, &stopped).status().expect("the command starts").success());
    same(&alone, &stopped);
    // The finished scene replaces the checkpoint in the view.
    let ends = std::time::Instant::now() + std::time::Duration::from_secs(60);
    while at(&follower).is_some() {
        assert!(std::time::Instant::now() < ends, "the finished scene is shown");
        std::thread::sleep(std::time::Duration::from_millis(50));
    }
}

#[test]
fn scenes_and_captures_are_looked_at_and_bad_cases_are_said() {
    let place = Place::new();
    let (capture, scene) = (place.at("tiny"), place.at("reef/scene"));
    let made = command()
        .args(["-q", "reconstruct", &capture, "--out", &scene, "--set", "iterations=2"])
        .status()
        .expect("the command starts");
    assert!(made.success());
    let view = |arguments: &[&str]| {
        let mut view = command();
        view.args(["-q", "view"]).args(arguments).arg("--no-open").stdout(Stdio::piped());
        let mut child = Ended(view.spawn().expect("the command starts"));
        let viewer = Viewer::of(child.0.stdout.take().expect("a pipe"));
        (child, viewer)
    };
    let (_child, viewer) = view(&[&scene, "--cameras", &capture, "--metres-per-unit", "0.5"]);
    let header = viewer.header();
    assert!(header["name"] == "reef" && header["metresPerUnit"] == 0.5, "{}", header["name"]);
    assert!(
        viewer
            .ask("/section", &json!({ "name": "geometry" }))
            .is_some_and(|(status, bytes)| status == 200 && bytes.starts_with(&[0x1f, 0x8b]))
    );
    assert_eq!(viewer.draw(&header, 0), Some(200));
    let (_child, viewer) = view(&[&capture]);
    let header = viewer.header();
    assert!(
        header["name"] == "tiny" && header["medium"]["kind"] == "none" && header["count"].as_u64() > Some(10)
    );
    // The page shows the cameras, and says that these points are no scene yet.
    assert_eq!((&header["points"], header["cameras"].as_array().map(Vec::len)), (&json!(true), Some(9)));

    let taken = TcpListener::bind(("127.0.0.1", 0)).expect("a port");
    let port = taken.local_addr().expect("an address").port().to_string();
    let said = |arguments: &[&str]| {
        let output = command().args(arguments).output().expect("the command starts");
        assert_eq!(output.status.code(), Some(2), "{arguments:?}");
        String::from_utf8_lossy(&output.stderr).into_owned()
    };
    assert!(said(&["view", &scene, "--port", &port]).contains("--port N"));
    assert!(said(&["view", &place.at("nowhere")]).contains("no such folder"));
    assert!(said(&["view", &place.at("tiny/sparse/0/images.bin")]).contains("this is a file"));
    assert!(said(&["view", "--follow", &place.at("nowhere/scene")]).contains("there is no folder"));
    assert!(said(&["view"]).contains("SCENE_DIR"));
    // Errors in files of views: the message has the file, the problem, and the expected content.
    let file = place.at("views.json");
    for (bytes, wrong) in [
        (None, "there is no such file"),
        (Some(&b"\xff"[..]), "not UTF-8 text"),
        (Some(b"{}"), "missing field"),
    ] {
        if let Some(bytes) = bytes {
            std::fs::write(&file, bytes).expect("written");
        }
        let told = said(&["view", &scene, "--views", &file]);
        assert!(told.contains("--views") && told.contains(wrong) && told.contains("Save file"), "{told}");
    }
    // A missing target is waited for, with a message.
    let mut waits = command();
    waits
        .args(["view", "--follow", &place.at("soon"), "--no-open"])
        .stdout(Stdio::null())
        .stderr(Stdio::piped());
    let mut waits = Ended(waits.spawn().expect("the command starts"));
    let lines = BufReader::new(waits.0.stderr.take().expect("a pipe")).lines();
    assert!(lines.map_while(Result::ok).any(|line| line.starts_with("nothing to show yet; waiting for")));
    assert!(said(&["view", &scene, "--metres-per-unit", "0"]).contains("positive"));
    assert!(said(&["reconstruct", &capture, "--out", &place.at("x"), "--port", "7007"]).contains("--view"));
}

/// The arguments of a process are public on a machine, so the viewer's key is not among them.
#[cfg(target_os = "linux")]
#[test]
fn the_browser_is_led_to_the_viewer_by_a_page_that_only_its_user_reads() {
    use std::os::unix::fs::PermissionsExt;

    let place = Place::new();
    let at = |name: &str| std::path::PathBuf::from(place.at(name));
    for folder in ["bin", "run"] {
        std::fs::create_dir(at(folder)).expect("a folder");
    }
    let script = format!("#!/bin/sh\necho \"$*\" > {0}.new; mv {0}.new {0}\n", place.at("opened"));
    std::fs::write(at("bin/xdg-open"), script).expect("written");
    std::fs::set_permissions(at("bin/xdg-open"), PermissionsExt::from_mode(0o755)).expect("allowed");
    let mut command = command();
    command.args(["-q", "view", &place.at("tiny")]).stdout(Stdio::piped());
    command.env("DISPLAY", ":0").env("XDG_RUNTIME_DIR", at("run"));
    let path = std::env::var("PATH").unwrap_or_default();
    let mut child = command.env("PATH", format!("{}:{path}", place.at("bin"))).spawn().expect("it starts");
    let mut address = String::new();
    BufReader::new(child.stdout.take().expect("a pipe")).read_line(&mut address).expect("a line");
    let token = address.trim().split_once('#').expect("an address with a key").1.to_string();
    let opened = (0..200).find_map(|_| {
        std::thread::sleep(std::time::Duration::from_millis(50));
        std::fs::read_to_string(at("opened")).ok()
    });
    let page = std::path::PathBuf::from(opened.expect("a browser was opened").trim());
    let (text, mode) = (std::fs::read_to_string(&page), std::fs::metadata(&page));
    let words = std::fs::read(format!("/proc/{}/cmdline", child.id())).expect("its words");
    std::process::Command::new("kill").arg(child.id().to_string()).status().expect("a signal");
    child.wait().expect("it ends");
    assert!(page.starts_with(at("run")) && !page.to_string_lossy().contains(&token), "{}", page.display());
    assert_eq!(mode.expect("there").permissions().mode() & 0o777, 0o600);
    assert!(
        text.expect("read").contains(address.trim()) && !String::from_utf8_lossy(&words).contains(&token)
    );
    assert!(!page.exists(), "it is removed when the viewer ends");
}
