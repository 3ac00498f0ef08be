//! Films that are refused, and targets that stay as they were.

use super::*;

#[test]
fn films_that_are_cut_off_or_no_films_are_refused() {
    let Some(dir) = place() else { return };
    let at = |name: &str| dir.path().join(name);
    let long = PICTURE.replace("1.5", "6").replace("1.7", "6");
    for (ending, more) in [("mp4", " -movflags +faststart"), ("mkv", "")] {
        let whole = film(at(&format!("whole.{ending}")), &format!("{long} {ENCODED}{more}"));
        let bytes = std::fs::read(&whole).unwrap();
        let cut = at(&format!("cut.{ending}"));
        std::fs::write(&cut, &bytes[..bytes.len() / 2]).unwrap();
        let said = open(&cut).err().map(|e| e.to_string()).unwrap_or_default();
        println!("{said}");
        assert!(
            said.contains("cut off") && said.contains("copy it again") && said.contains("cut."),
            "{said}"
        );
    }
    // Without its index, an MP4 cannot be read at all.
    let whole = film(at("late.mp4"), &format!("{PICTURE} {ENCODED}"));
    let bytes = std::fs::read(&whole).unwrap();
    std::fs::write(at("none.mp4"), &bytes[..bytes.len() / 2]).unwrap();
    std::fs::write(at("text.mp4"), "no film").unwrap();
    film(at("sound.mp4"), "-f lavfi -i sine=duration=1 -c:a aac");
    for (name, part) in [
        ("none.mp4", "copy it again"),
        ("text.mp4", "copy it again"),
        ("sound.mp4", "no film"),
        ("nowhere.mp4", "no such film"),
    ] {
        let said = open(&at(name)).err().map(|e| e.to_string()).unwrap_or_default();
        assert!(said.contains(part) && said.contains(name), "{said}");
    }
    // Damage in the middle is counted, and the film is read to its end.
    let mut damaged = std::fs::read(at("whole.mp4")).unwrap();
    let middle = damaged.len() / 2;
    damaged[middle..middle + 3000].fill(0x55);
    std::fs::write(at("damaged.mp4"), damaged).unwrap();
    let mut reader = open(&at("damaged.mp4")).unwrap();
    let read = reader.by_ref().filter(|frame| frame.is_ok()).count();
    println!("damaged: {read} frames, {} errors", reader.damages());
    assert!(read > 150 && reader.damages() > 0, "{read}");
}

#[test]
fn a_target_is_never_half_written_or_replaced_unasked() {
    let Some(dir) = place() else { return };
    let at = |name: &str| dir.path().join(name);
    let a = film(at("a.mp4"), &format!("{PICTURE} {ENCODED}"));
    let info = open(&a).unwrap().info().clone();
    let create = |target: &Path, choices| FilmWriter::create(&Programs::default(), &info, target, choices);
    let said = |made: Result<FilmWriter, PrepareError>| made.err().map(|e| e.to_string()).unwrap_or_default();
    std::fs::write(at("taken.mp4"), "precious").unwrap();
    for (target, part) in
        [("taken.mp4", "already"), ("a.mp4", "the film itself"), ("b.gif", ".mp4"), ("c", ".mp4")]
    {
        let said = said(create(&at(target), FilmChoices::default()));
        assert!(said.contains(part) && said.contains(target), "{said}");
    }
    let wrong = FilmChoices { quality: Some(52), ..FilmChoices::default() };
    assert!(said(create(&at("b.mp4"), wrong)).contains("0 (best) to 51"));
    let black = vec![0; 3 * 96 * 64];
    let replace = FilmChoices { replace: true, ..FilmChoices::default() };
    // Dropped, given wrong frames, or finished without any: the file stays as it was.
    let mut writer = create(&at("taken.mp4"), replace).unwrap();
    writer.write(&black, 0.5).unwrap();
    for (frame, seconds, part) in
        [(&black[3..], 1.0, "bytes"), (&black, 0.5, "not earlier"), (&black, f64::NAN, "NaN")]
    {
        let said = writer.write(frame, seconds).unwrap_err().to_string();
        assert!(said.contains(part), "{said}");
    }
    drop(writer);
    let said = create(&at("taken.mp4"), replace).unwrap().finish().unwrap_err().to_string();
    assert!(said.contains("no frame was written"), "{said}");
    // An ffmpeg that fails: audio that the target cannot hold.
    let raw = film(at("raw.mkv"), &format!("{PICTURE} {ENCODED} -c:a pcm_s16le"));
    match copy(&raw, &at("d.mp4")) {
        Err(error) => {
            let said = error.to_string();
            println!("{said}");
            assert!(said.contains("ffmpeg cannot") && said.contains("pcm_s16le"), "{said}");
        }
        Ok(_) => println!("this ffmpeg writes that audio into a .mp4"),
    }
    assert_eq!(std::fs::read(at("taken.mp4")).unwrap(), b"precious");
    let mut writer = create(&at("taken.mp4"), replace).unwrap();
    writer.write(&black, 0.5).unwrap();
    writer.finish().unwrap();
    assert_eq!(frames(&at("taken.mp4")).len(), 1);
    assert!(names(dir.path()).iter().all(|n| !n.starts_with('.')), "{:?}", names(dir.path()));
}

/// The variable that gives the child process of a test its folder.
const CHILD: &str = "USE3D_FILM_CHILD";

#[test]
fn a_killed_process_leaves_no_target_and_the_next_one_removes_its_file() {
    if let Some(folder) = std::env::var_os(CHILD).map(PathBuf::from) {
        let info = open(&folder.join("a.mp4")).unwrap().info().clone();
        let target = folder.join("b.mp4");
        let mut writer =
            FilmWriter::create(&Programs::default(), &info, &target, FilmChoices::default()).unwrap();
        for i in 0u32.. {
            writer.write(&vec![(i % 251) as u8; 3 * 96 * 64], f64::from(i) / 30.0).unwrap();
        }
        return;
    }
    let Some(dir) = place() else { return };
    let a = film(dir.path().join("a.mp4"), &format!("{PICTURE} {ENCODED}"));
    let test = "refused::a_killed_process_leaves_no_target_and_the_next_one_removes_its_file";
    let mut child = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", test])
        .env(CHILD, dir.path())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let waiting = std::time::Instant::now();
    let hidden = || names(dir.path()).into_iter().find(|n| n.starts_with('.'));
    while !hidden().is_some_and(|n| std::fs::metadata(dir.path().join(n)).is_ok_and(|m| m.len() > 0)) {
        assert!(waiting.elapsed().as_secs() < 60 && child.try_wait().unwrap().is_none());
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(!dir.path().join("b.mp4").exists());
    copy(&a, &dir.path().join("b.mp4")).unwrap();
    assert_eq!(names(dir.path()), ["a.mp4", "b.mp4"]);
}

#[test]
fn a_missing_ffmpeg_is_said_with_the_commands_that_bring_it() {
    let nowhere = PathBuf::from("/nowhere/at-all");
    let programs = Programs { ffmpeg: nowhere.clone(), python: nowhere, ..Programs::default() };
    let stop = AtomicBool::new(false);
    let watch = StepWatch { stop: &stop, progress: &|_| (), note: &|_| () };
    let said = FilmReader::open(&programs, Path::new("a.mp4"), &watch)
        .err()
        .map(|e| e.to_string())
        .unwrap_or_default();
    assert!(said.contains("apt install colmap ffmpeg"), "{said}");
}
