//! Tests of a pipeline file that grows while the tasks of a submission wait.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use super::many::Many;
use super::{read, stand_ins, submit};

/// Keeps the submitted scripts in a list, and runs none.
const WAITING: &str = r#"
echo "${!#}" >> "$here/waiting"
number=$(( $(cat "$here/number" 2>/dev/null || echo 100) + 1 )); echo "$number" > "$here/number"
echo "$number;cluster"
"#;

/// Three captures of which the first is not there yet, a pipeline with a scene for each, and a scheduler that
/// only queues. The functions submit, and run the scripts that wait.
struct Growing {
    many: Many,
    path: String,
    layout: &'static str,
}

impl Growing {
    fn new(layout: &'static str) -> Self {
        let many = Many::new(&["s0", "s1", "s2"].map(String::from));
        fs::create_dir(many.at("dives")).expect("a folder");
        for name in ["s1", "s2"] {
            fs::rename(many.at(name), many.at("dives").join(name)).expect("moved");
        }
        fs::write(many.at("many.toml"), "name = \"many\"\n[[scene]]\nfrom = \"dives/*\"\n").expect("written");
        let path = stand_ins(&many);
        fs::rename(many.at("bin/sbatch"), many.at("bin/now")).expect("moved");
        fs::write(
            many.at("bin/sbatch"),
            format!("#!/bin/bash\nhere={}\n{WAITING}", many.at("bin").display()),
        )
        .expect("written");
        fs::set_permissions(many.at("bin/sbatch"), fs::Permissions::from_mode(0o755)).expect("executable");
        let site = format!("command = \"{}\"\ncpus = 1\nat_once = 2\n", env!("CARGO_BIN_EXE_use3d"));
        fs::write(many.at("cluster.toml"), site).expect("written");
        Self { many, path, layout }
    }

    fn submit(&self, extra: &[&str]) -> (Option<i32>, String) {
        let words = ["--cluster", "cluster.toml", "--layout", self.layout];
        submit(&self.many, &self.path, "slurm", "cache", &[&words[..], extra].concat())
    }

    /// Runs the scripts that wait and whose paths contain `part`; the last one ends with this exit code.
    fn run_waiting(&self, part: &str) -> Option<i32> {
        let waiting = read(&self.many.at("bin/waiting"));
        let mut code = None;
        for script in waiting.lines().filter(|script| script.contains(part)) {
            let command = match script.ends_with("finish.sbatch") {
                true => Path::new("bash").to_path_buf(),
                false => self.many.at("bin/now"),
            };
            let mut command = std::process::Command::new(command);
            command.arg(script).env("PATH", &self.path).env("SLURM_JOB_ID", "999");
            code = command.output().expect("the command starts").status.code();
        }
        code
    }

    fn made(&self, stage: &str) -> usize {
        fs::read_dir(self.many.at("cache/v1/artifacts").join(stage)).map_or(0, Iterator::count)
    }
}

#[test]
fn scenes_that_are_added_while_tasks_wait_change_nothing_for_them_and_are_submitted_alone() {
    for layout in ["stages", "workers"] {
        let batch = Growing::new(layout);
        let (code, text) = batch.submit(&[]);
        assert_eq!(code, Some(0), "{text}");
        let first = read(&batch.many.at("bin/waiting"));
        fs::write(batch.many.at("bin/queue"), "101\n").expect("written");
        // Nothing is new.
        let (code, text) = batch.submit(&[]);
        assert!(code == Some(2) && text.contains("still in the queue, and no scene is new"), "{text}");
        // A new scene comes first in the file, so it would have the number of another one.
        fs::rename(batch.many.at("s0"), batch.many.at("dives/s0")).expect("moved");
        let (code, text) = batch.submit(&[]);
        assert!(code == Some(0) && text.contains("1 scene and variant is new"), "{text}");
        let second = read(&batch.many.at("bin/waiting"))[first.len()..].to_string();
        assert!(
            second.lines().count() > 0 && second.lines().all(|line| line.contains("/added-")),
            "{second}"
        );
        let lists: Vec<String> =
            second.lines().map(|script| read(&Path::new(script).with_extension("tasks"))).collect();
        assert!(!lists.concat().contains("s1") && !lists.concat().contains("s2"), "{lists:?}");
        // `cancel` and a third submission know the jobs of both.
        let record = read(&batch.many.at("use3d-out/many-submit/submitted.json"));
        assert_eq!(record.matches("\"finish\"").count(), 2, "{record}");
        assert!(["s0", "s1", "s2"].iter().all(|scene| record.contains(scene)), "{record}");
        assert_eq!(batch.submit(&[]).0, Some(2));
        // The tasks that waited compute their own scenes, and end well.
        let ended = batch.run_waiting("many-submit/");
        let log = read(&batch.many.at("bin/tasks.log"));
        assert_eq!((ended, batch.made("evaluate")), (Some(0), 3), "{log}");
        assert!(!log.contains("not the submitted pipeline"), "{log}");
        assert_eq!(batch.many.scores("use3d-out/many".as_ref()).len(), 3, "{log}");
    }
}

#[test]
fn hyperqueue_gets_new_scenes_in_a_job_of_their_own() {
    let batch = Growing::new("stages");
    let body = "#!/bin/bash\ncase \"$*\" in *'job list') cat open; exit 0 ;; *) echo 12 ;; esac\n";
    fs::write(batch.many.at("bin/hq"), body).expect("written");
    fs::set_permissions(batch.many.at("bin/hq"), fs::Permissions::from_mode(0o755)).expect("executable");
    fs::write(batch.many.at("open"), "12 WAITING\n").expect("written");
    let hq = || submit(&batch.many, &batch.path, "hq", "cache", &["--layout", "stages"]);
    let folder = batch.many.at("use3d-out/many-submit");
    assert_eq!(hq().0, Some(0));
    assert!(read(&folder.join("job.toml")).contains("\"s1\""));
    assert_eq!(hq().0, Some(2));
    fs::rename(batch.many.at("s0"), batch.many.at("dives/s0")).expect("moved");
    let (code, text) = hq();
    assert!(code == Some(0) && text.contains("1 scene and variant is new"), "{text}");
    let added = fs::read_dir(&folder).expect("a folder").flatten().map(|entry| entry.path());
    let added: Vec<_> = added.filter(|path| path.join("job.toml").is_file()).collect();
    let job = read(&added[0].join("job.toml"));
    assert!(added.len() == 1 && job.contains("\"s0\"") && !job.contains("\"s1\""), "{job}");
    // The other scheduler does not take these jobs for its own.
    let (code, text) = batch.submit(&[]);
    assert!(
        code == Some(2) && text.contains("still in the queue") && text.contains("hq job cancel"),
        "{text}"
    );
    // A record of an older version does not say what waits.
    let record = read(&folder.join("submitted.json"));
    let old: serde_json::Value = serde_json::from_str(&record).expect("JSON");
    let old = serde_json::json!({ "scheduler": old["scheduler"], "jobs": old["jobs"] });
    fs::write(folder.join("submitted.json"), old.to_string()).expect("written");
    assert_eq!(hq().0, Some(2));
}

#[test]
fn tasks_of_a_grown_file_compute_their_own_scenes_and_leave_those_that_were_edited() {
    for layout in ["stages", "workers"] {
        let batch = Growing::new(layout);
        assert_eq!(batch.submit(&[]).0, Some(0));
        fs::rename(batch.many.at("s0"), batch.many.at("dives/s0")).expect("moved");
        assert_eq!(batch.run_waiting(""), Some(0), "{}", read(&batch.many.at("bin/tasks.log")));
        assert_eq!((batch.made("import"), batch.made("evaluate"), batch.made("report")), (2, 2, 1));

        let batch = Growing::new(layout);
        assert_eq!(batch.submit(&[]).0, Some(0));
        let text = read(&batch.many.at("many.toml"));
        let edited = "[[scene]]\nname = \"s2\"\ncapture = \"dives/s2\"\nimport = { max_side = 48 }\n";
        fs::write(batch.many.at("many.toml"), text + edited).expect("written");
        assert_eq!(batch.run_waiting(""), Some(1), "`finish` misses the edited scene");
        let log = read(&batch.many.at("bin/tasks.log"));
        assert_eq!((batch.made("import"), batch.made("evaluate")), (1, 1), "{log}");
        let said =
            if layout == "stages" { "not the submitted pipeline" } else { "s2: changed or removed since" };
        assert!(log.contains(said), "{log}");
    }
}
