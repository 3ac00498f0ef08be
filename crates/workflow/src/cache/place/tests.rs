use super::*;
use crate::cache::machine::ProcessId;

/// A finished sibling with these files and a record.
fn made(folder: &Path, files: &[(&str, &str)]) -> PathBuf {
    let made = sibling(folder);
    write(&made, files);
    record(&made, Some(Digest::of(files[0].1.as_bytes()))).unwrap();
    made
}

fn write(folder: &Path, files: &[(&str, &str)]) {
    for (name, text) in files {
        let path = folder.join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }
}

fn read(path: PathBuf) -> String {
    fs::read_to_string(path).unwrap_or_default()
}

/// Names below a folder, sorted.
fn names(folder: &Path) -> Vec<String> {
    files::list(folder).unwrap().into_iter().map(|(name, _)| name).collect()
}

#[test]
fn only_what_the_record_lists_is_replaced() {
    let dir = tempfile::tempdir().unwrap();
    let scene = dir.path().join("deep/scene");
    fs::create_dir_all(parent(&scene)).unwrap();
    put(
        &made(&scene, &[("scene.json", "one"), ("maps/old.png", "one"), ("maps/both.png", "one")]),
        &scene,
        false,
    )
    .unwrap();
    write(&scene, &[("maps/mine.txt", "mine"), ("notes/mine.txt", "mine")]);

    let second = made(&scene, &[("scene.json", "two"), ("maps/both.png", "two")]);
    let error = put(&second, &scene, false).unwrap_err().to_string();
    assert!(error.contains("--force") && read(scene.join("scene.json")) == "one", "{error}");
    put(&second, &scene, true).unwrap();
    assert_eq!(
        names(&scene),
        ["manifest.json", "maps/both.png", "maps/mine.txt", "notes/mine.txt", "scene.json"],
        "the old file is gone, others' files are not"
    );
    assert_eq!(read(scene.join("maps/both.png")), "two");
    assert_eq!(fs::read_dir(parent(&scene)).unwrap().count(), 1, "nothing is left beside it");
    let Standing::Ours(ours) = look(&scene, Look::Close).unwrap() else { panic!("ours") };
    assert_eq!((ours.whole, ours.key), (true, Some(Digest::of(b"two"))));
}

#[test]
fn what_is_not_ours_is_refused_untouched() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    write(&at("project"), &[("scene.json", "{}"), ("thesis.txt", "thesis")]);
    // A web browser's extension has a manifest too.
    write(&at("web"), &[("manifest.json", "{\"manifest_version\": 3}"), ("page.js", "")]);
    // A record that lists a path outside its folder lists nothing that exists in it.
    let outside = format!(
        "{{\"format\": \"{FORMAT}\", \"schema\": 1, \"files\": [{{\"path\": \"../thesis.txt\", \"size\": 6, \"digest\": \"{}\"}}]}}",
        Digest::of(b"thesis")
    );
    write(&at("sly"), &[("manifest.json", &outside)]);
    write(dir.path(), &[("thesis.txt", "thesis"), ("file", "file")]);
    // A result of this program, but edited since.
    put(&made(&at("edited"), &[("scene.json", "one")]), &at("edited"), false).unwrap();
    write(&at("edited"), &[("scene.json", "two")]);
    // A result of this program, but with a file of the user that has the name of a new file.
    put(&made(&at("shared"), &[("scene.json", "one")]), &at("shared"), false).unwrap();
    write(&at("shared"), &[("ubaf.safetensors", "mine")]);

    for name in ["project", "web", "edited", "shared", "file"] {
        let before = if name == "file" { Vec::new() } else { names(&at(name)) };
        let next = made(&at(name), &[("scene.json", "new"), ("ubaf.safetensors", "new")]);
        let error = put(&next, &at(name), true).unwrap_err();
        assert!(matches!(error, PlaceError::Occupied { .. }), "{name}: {error}");
        if name != "file" {
            assert_eq!(names(&at(name)), before, "{name}");
        }
    }
    assert_eq!(read(at("shared/ubaf.safetensors")), "mine");
    assert!(check(&at("project"), true).is_err() && check(&at("edited"), true).is_err());
    let next = made(&at("sly"), &[("scene.json", "new")]);
    put(&next, &at("sly"), true).unwrap();
    assert_eq!(read(at("thesis.txt")), "thesis");
}

#[cfg(unix)]
#[test]
fn links_are_neither_followed_nor_replaced() {
    use std::os::unix::fs::symlink;
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    write(&at("real"), &[("mine.txt", "mine")]);
    symlink(at("real"), at("linked")).unwrap();
    put(&made(&at("inside"), &[("a/b.png", "one")]), &at("inside"), false).unwrap();
    fs::remove_dir_all(at("inside/a")).unwrap();
    symlink(at("real"), at("inside/a")).unwrap();
    for name in ["linked", "inside"] {
        let next = made(&at(name), &[("a/b.png", "two")]);
        assert!(put(&next, &at(name), true).is_err(), "{name}");
        fs::remove_dir_all(next).unwrap();
    }
    assert_eq!(read(at("real/mine.txt")), "mine");
    assert!(at("linked").is_symlink() && at("inside/a").is_symlink());
}

#[test]
fn what_a_killed_process_left_half_made_is_swept() {
    let dir = tempfile::tempdir().unwrap();
    let mine = sibling(&dir.path().join("scene"));
    let dead = ProcessId { started: 1, ..ProcessId::this() };
    let left = dir.path().join(format!("{MADE}{}-0", dead.name()));
    let old = dir.path().join(format!("{OLD}{}-1", dead.name()));
    for folder in [&mine, &left, &old] {
        write(folder, &[("deep/a", "a")]);
    }
    // A delivery moved these aside and was killed. One also holds a file of the user; one lacks some of our
    // files.
    let [kept, ours] = ["2", "3"].map(|n| dir.path().join(format!("{OLD}{}-{n}", dead.name())));
    for folder in [&kept, &ours] {
        write(folder, &[("deep/a", "a"), ("b", "b")]);
        record(folder, None).unwrap();
    }
    write(&kept, &[("notes.txt", "mine")]);
    fs::remove_file(ours.join("b")).unwrap();
    sweep(dir.path());
    assert!(mine.exists() && old.exists() && kept.exists(), "in use, or perhaps somebody's");
    for swept in [left, ours] {
        assert_eq!(swept.exists(), dead.is_alive() != Some(false));
    }
}

#[test]
fn an_edit_is_seen_by_the_quick_look_too() {
    let dir = tempfile::tempdir().unwrap();
    let scene = dir.path().join("scene");
    put(&made(&scene, &[("scene.json", "one")]), &scene, false).unwrap();
    assert!(matches!(look(&scene, Look::Quick).unwrap(), Standing::Ours(_)));
    fs::write(scene.join("scene.json"), "two").unwrap();
    let later = SystemTime::now() + std::time::Duration::from_secs(5);
    fs::File::options().write(true).open(scene.join("scene.json")).unwrap().set_modified(later).unwrap();
    assert!(matches!(look(&scene, Look::Quick).unwrap(), Standing::Foreign(_)));
}

#[test]
fn deliveries_into_one_place_at_once_leave_one_of_them_whole() {
    let dir = tempfile::tempdir().unwrap();
    let scene = dir.path().join("scene");
    std::thread::scope(|scope| {
        for i in 0..4 {
            let scene = &scene;
            scope.spawn(move || {
                for round in 0..5 {
                    let text = format!("{i} {round}");
                    put(&made(scene, &[("a", &text), ("deep/b", &text)]), scene, true).unwrap();
                }
            });
        }
    });
    let Standing::Ours(ours) = look(&scene, Look::Close).unwrap() else { panic!("ours") };
    assert!(ours.whole);
    assert_eq!(read(scene.join("a")), read(scene.join("deep/b")));
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
}
