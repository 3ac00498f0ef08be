//! Tests of the files for schedulers, word for word (`USE3D_UPDATE_SNAPSHOTS=1` writes `golden/` again), and
//! of their effect in a shell.

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use use3d_cluster::jobs::{self, After, Job, Layout};
use use3d_cluster::site::Site;
use use3d_cluster::submission::{Submission, Submitted};
use use3d_cluster::{ClusterError, hyperqueue, slurm};
use use3d_workflow::Killed;
use use3d_workflow::code::CodeTable;
use use3d_workflow::history::Forecast;
use use3d_workflow::plan::{PlannedNode, State};
use use3d_workflow::{Plan, Registry, Scope, Stage};

#[derive(Default, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
struct Nothing {}

fn registry() -> Registry {
    let stage = |name, scope| Stage::new(name, scope, |_, _: &Nothing| Ok(())).made_of(&[], &[]);
    let stages = vec![
        stage("import", Scope::Scene).external("capture", "capture"),
        stage("pairs", Scope::Shared),
        stage("calibrate", Scope::Shared).input("pairs", "pairs"),
        stage("reconstruct", Scope::Scene).input("capture", "import"),
        stage("enhance", Scope::Scene).input("scene", "reconstruct").input("calibrator", "calibrate"),
        stage("evaluate", Scope::Scene).input("scene", "enhance").input("capture", "import"),
        stage("report", Scope::Batch).input("scores", "evaluate"),
    ];
    Registry::new(stages, &CodeTable::default()).expect("a table")
}

fn node(stage: &'static str, scene: &str, variant: &str, state: State, minutes: f64) -> PlannedNode {
    let forecast = Forecast {
        seconds: 60.0 * minutes,
        least: 50.0 * minutes,
        most: 80.0 * minutes,
        output: 1 << 20,
        peak_memory: 3_000_000_000,
        records: 3,
        own: true,
    };
    PlannedNode {
        stage,
        scene: scene.to_string(),
        variant: variant.to_string(),
        state,
        key: None,
        artifact: None,
        checkpoints: None,
        changes: Vec::new(),
        usual_cost: 1.0,
        forecast: (minutes > 0.0).then(|| Box::new(forecast)),
        expected: None,
        memory: Some(2_000_000_000),
        shared_with: None,
        failed: None,
        had: false,
        killed: None,
        working: None,
        needs: Vec::new(),
    }
}

/// Three scenes, one of them done; the calibrator is done too, and one stage has never run.
fn plan() -> Plan {
    let run = || State::Run("never made".to_string());
    let wait = || State::Waiting(vec!["import".to_string()]);
    let mut nodes = vec![
        node("pairs", "", "", State::Cached, 1.0),
        node("calibrate", "", "", State::Run("never made".to_string()), 10.0),
    ];
    for scene in ["Panama", "Curaçao north", "done"] {
        for variant in ["full", "mlp"] {
            for (stage, minutes) in
                [("import", 2.0), ("reconstruct", 100.0), ("enhance", 40.0), ("evaluate", 0.0)]
            {
                let state = match (scene, stage) {
                    ("done", _) | ("Panama", "import") => State::Cached,
                    (_, "import") => run(),
                    _ => wait(),
                };
                let mut node = node(stage, scene, variant, state, minutes);
                if stage == "import" && variant == "mlp" {
                    node.shared_with = Some(format!("{scene} · full · import"));
                }
                nodes.push(node);
            }
        }
    }
    nodes.push(node("report", "", "", wait(), 0.0));
    // The inputs of every node follow the table of stages; a comparison also reads stage 1 of the first
    // variant.
    let find = |nodes: &[PlannedNode], stage: &str, scene: &str, variant: &str| {
        nodes.iter().position(|n| n.stage == stage && n.scene == scene && n.variant == variant)
    };
    for i in 0..nodes.len() {
        let (scene, variant) = (nodes[i].scene.clone(), nodes[i].variant.clone());
        let own = |stage: &str| find(&nodes, stage, &scene, &variant);
        let needs = match nodes[i].stage {
            "import" if nodes[i].shared_with.is_some() => vec![find(&nodes, "import", &scene, "full")],
            "calibrate" => vec![own("pairs")],
            "reconstruct" => vec![own("import")],
            "enhance" => vec![own("reconstruct"), find(&nodes, "calibrate", "", "")],
            "evaluate" => {
                vec![own("enhance"), own("import"), find(&nodes, "reconstruct", &scene, "full")]
            }
            _ => Vec::new(),
        };
        nodes[i].needs = needs.into_iter().flatten().collect();
    }
    Plan { pipeline: "use26".to_string(), nodes, seconds: 0.0 }
}

fn site() -> Site {
    let text = r#"
        account = "reef"
        partition = "cpu"
        cpus = 8
        command = "use3d"
        longest = "12h"
        setup = ["module load cuda/12.4", "export USE3D_MODELS=/proj/models"]
        [stage.reconstruct]
        partition = "gpu"
        options = ["--gres=gpu:1"]
        resources = { "gpus/nvidia" = 1 }
        arguments = ["--set", "reconstruct.log_every=100"]
        [stage.enhance]
        memory = "32GB"
        time = "2h"
    "#;
    Site::parse(text, &["reconstruct", "enhance"]).expect("a site")
}

fn submission() -> Submission {
    Submission {
        name: "use26".to_string(),
        by: "use3d submit slurm pipelines/use26.toml".to_string(),
        place: PathBuf::from("/proj/reef work"),
        run: ["pipelines/use26.toml", "--cache", "/scratch/use3d", "--set", "enhance.rank=4"]
            .map(String::from)
            .to_vec(),
        results: ["--out", "/proj/reef work/use3d-out/use26"].map(String::from).to_vec(),
        folder: PathBuf::from("/proj/reef work/use3d-out/use26-submit"),
        variables: vec![("SEATHRU".to_string(), "/proj/reef data/SeaThru".to_string())],
        id: "5a0d9a1c-1796000000".to_string(),
        cells: BTreeMap::new(),
        before: Submitted::default(),
        record: PathBuf::from("/proj/reef work/use3d-out/use26-submit"),
    }
}

fn check(name: &str, text: &str) {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden").join(name);
    if std::env::var_os("USE3D_UPDATE_SNAPSHOTS").is_some() {
        fs::write(&file, text).expect("the golden can be written");
    }
    let written = fs::read_to_string(&file).unwrap_or_default();
    assert!(
        text == written,
        "{} differs; read it, and write it anew with USE3D_UPDATE_SNAPSHOTS=1:\n{text}",
        file.display()
    );
}

fn of(layout: Layout) -> Vec<Job> {
    jobs::of(&plan(), &registry(), &site(), layout, None).expect("jobs")
}

#[test]
fn scripts_are_written_as_they_were_read() {
    for (layout, name) in [(Layout::Workers, "workers"), (Layout::Stages, "stages")] {
        let jobs = of(layout);
        let mut all = String::new();
        for (at, job) in jobs.iter().enumerate() {
            let numbers: Vec<String> = (0..at).map(|n| (100 + n).to_string()).collect();
            let dependency = slurm::dependency(job, &numbers).unwrap_or_default();
            all += &format!("==> sbatch {dependency} {}.sbatch\n", job.name);
            all += &slurm::script(job, &submission(), &site());
            if !job.cells.is_empty() {
                all += &format!("==> {}.tasks\n{}", job.name, job.list());
            }
        }
        check(&format!("slurm-{name}.txt"), &all);
        let hq = format!(
            "==> task.sh\n{}==> job.toml\n{}",
            hyperqueue::script(&submission(), &site()),
            hyperqueue::file(&jobs, &submission())
        );
        check(&format!("hyperqueue-{name}.txt"), &hq);
    }
}

#[test]
fn what_a_task_says_goes_into_the_folder_of_logs_whatever_the_folder_is_called() {
    let folder = PathBuf::from("/proj/my.log.dir");
    let file = hyperqueue::file(&of(Layout::Workers), &Submission { folder, ..submission() });
    for name in [
        "workers-0-%{INSTANCE_ID}.log",
        "workers-0-%{INSTANCE_ID}.err",
        "finish-%{INSTANCE_ID}.log",
        "finish-%{INSTANCE_ID}.err",
    ] {
        assert!(file.contains(&format!("\"/proj/my.log.dir/logs/{name}\"")), "{name}: {file}");
    }
}

#[test]
fn a_percent_sign_in_a_folders_name_is_no_pattern_of_slurms() {
    let folder = PathBuf::from("/proj/10%j");
    let jobs = of(Layout::Workers);
    let text = slurm::script(&jobs[0], &Submission { folder, ..submission() }, &site());
    assert!(text.contains("#SBATCH --output=/proj/10%%j/logs/workers-%A_%a.log\n"), "{text}");
}

#[test]
fn a_command_of_several_words_stays_several_words() {
    let command = ["apptainer", "exec", "my tools/use3d.sif", "use3d"].map(String::from).to_vec();
    let site = Site { command: Some(command), ..site() };
    let words = "apptainer exec 'my tools/use3d.sif' use3d ";
    let slurm = slurm::script(&of(Layout::Workers)[0], &submission(), &site);
    assert!(slurm.lines().any(|line| line.starts_with(words)), "{slurm}");
    let hq = hyperqueue::script(&submission(), &site);
    assert_eq!(hq.matches(&format!("{words}\"$@\"")).count(), 2, "{hq}");
}

#[test]
fn hyperqueue_is_asked_for_memory_unless_a_site_says_otherwise() {
    let asked = |own: &[(&str, u64)]| {
        let mut jobs = of(Layout::Workers);
        jobs[0].asks.needs.resources = own.iter().map(|(name, n)| ((*name).to_string(), *n)).collect();
        let file = hyperqueue::file(&jobs[..1], &submission());
        let at = file.find("resources]").expect("resources");
        file[at..].lines().skip(1).take_while(|l| !l.is_empty()).collect::<Vec<_>>().join(", ")
    };
    let memory = of(Layout::Workers)[0].asks.memory.div_ceil(1 << 20);
    assert_eq!(asked(&[]), format!("cpus = 8, mem = {memory}"));
    assert_eq!(asked(&[("mem", 77)]), "cpus = 8, mem = 77");
    assert_eq!(asked(&[("mem", 0), ("fpga", 1)]), "cpus = 8, fpga = 1");
}

#[test]
fn a_script_that_is_being_read_is_not_written_into() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut submission = Submission { folder: folder.path().join("submit"), ..submission() };
    let jobs = of(Layout::Workers);
    hyperqueue::write(&jobs, &submission, &site()).expect("written");
    let script = hyperqueue::script_path(&submission);
    // A hard link stands for a shell that has the file open: a shell reads a script piece by piece.
    let read = folder.path().join("read");
    fs::hard_link(&script, &read).expect("linked");
    let before = fs::read_to_string(&read).expect("text");
    submission.by = "another command".to_string();
    hyperqueue::write(&jobs, &submission, &site()).expect("written");
    assert_eq!(fs::read_to_string(&read).expect("text"), before);
    assert!(fs::read_to_string(&script).expect("text").contains("another command"));
}

#[test]
fn every_missing_artifact_has_one_task_and_each_waits_for_what_it_needs() {
    let jobs = of(Layout::Stages);
    let names: Vec<&str> = jobs.iter().map(|j| j.name.as_str()).collect();
    let expected = [
        "import",
        "calibrate",
        "reconstruct-1",
        "reconstruct-2",
        "reconstruct-3",
        "reconstruct-4",
        "enhance-1",
        "enhance-2",
        "enhance-3",
        "enhance-4",
        "evaluate-1",
        "evaluate-2",
        "evaluate-3",
        "evaluate-4",
        "finish",
    ];
    assert_eq!(names, expected);
    // The import that two variants share is one task; the finished scene is in no list. A scene has the same
    // number everywhere, and a scene that does not wait for an import is in an array of its own.
    let tasks = |at: usize| (jobs[at].tasks.clone().unwrap_or_default(), jobs[at].cells.join(" "));
    assert_eq!(tasks(0), (vec![1], "Curaçao north@full".to_string()));
    assert_eq!(tasks(2), (vec![0], "Panama@full".to_string()));
    assert_eq!(tasks(3), (vec![0], "Panama@mlp".to_string()));
    assert_eq!(tasks(4), (vec![1], "Curaçao north@full".to_string()));
    assert_eq!(tasks(5), (vec![1], "Curaçao north@mlp".to_string()));
    assert_eq!((jobs[2].after.as_slice(), jobs[3].after.as_slice()), (&[][..], &[][..]));
    assert_eq!(
        (jobs[4].after.as_slice(), jobs[5].after.as_slice()),
        (&[After::Same(0)][..], &[After::Same(0)][..])
    );
    assert_eq!(jobs[6].after, [After::Done(1), After::Same(2)]);
    // A comparison of variants waits for the same scene of the reference variant, and for no other.
    assert_eq!(jobs[11].cells, ["Panama@mlp"]);
    assert_eq!(jobs[11].after, [After::Same(2), After::Same(7)]);
    assert_eq!(jobs[14].after, (0..14).map(After::Over).collect::<Vec<_>>());
    // 1.5 times the longest duration, but no more than the site allows.
    assert_eq!(jobs[2].asks.time, Duration::from_secs(100 * 80 * 3 / 2 + 300));
    assert_eq!(jobs[6].asks.time, Duration::from_secs(7200));
    assert_eq!(jobs[6].asks.memory, 32_000_000_000);
    // A stage that never ran requests the site's defaults.
    assert_eq!(jobs[10].asks.time, Duration::from_secs(4 * 3600));
    let mut killed = plan();
    for node in killed.nodes.iter_mut().filter(|n| n.stage == "evaluate") {
        node.killed = Some(Box::new(Killed {
            host: "n1".to_string(),
            process: 7,
            task: None,
            seconds: 3,
            peak_memory: 40_000_000_000,
            times: 1,
        }));
    }
    let again = jobs::of(&killed, &registry(), &site(), Layout::Stages, None).expect("jobs");
    assert_eq!(again[10].asks.memory, 60_000_000_000);
    assert!(again.last().expect("finish").asks.memory < 60_000_000_000);

    let count = |jobs: &[Job]| jobs.iter().map(|j| j.tasks.as_ref().map(Vec::len)).collect::<Vec<_>>();
    let workers = of(Layout::Workers);
    assert_eq!(count(&workers), [Some(4), None]);
    assert!(workers[1].words.contains(&"--gather".to_string()), "{:?}", workers[1].words);
    let one = jobs::of(&plan(), &registry(), &site(), Layout::Workers, Some(1)).expect("jobs");
    assert_eq!((count(&one)[0], one[0].asks.time), (Some(1), Duration::from_secs(12 * 3600)));

    let mut done = plan();
    done.nodes.iter_mut().for_each(|n| n.state = State::Cached);
    assert_eq!(jobs::of(&done, &registry(), &site(), Layout::Stages, None).expect("none"), []);
    // Only the report is missing: one task.
    done.nodes.last_mut().expect("the report").state = State::Run("changed".to_string());
    let jobs = jobs::of(&done, &registry(), &site(), Layout::Workers, None).expect("one");
    assert_eq!(jobs.iter().map(|j| j.name.as_str()).collect::<Vec<_>>(), ["finish"]);
    let mut odd = plan();
    odd.nodes[3].scene = "two\nlines".to_string();
    let error = jobs::of(&odd, &registry(), &site(), Layout::Stages, None).expect_err("no line of a list");
    assert!(matches!(error, ClusterError::Name { .. }), "{error}");
}

/// Many scenes in three variants that share everything up to stage 2, as in an ablation of stage 2.
fn ablation(scenes: usize) -> Plan {
    let mut nodes = Vec::new();
    for scene in 0..scenes {
        let name = format!("s{scene:04}");
        let first = nodes.len();
        for variant in ["full", "half", "none"] {
            let at = nodes.len();
            let mut own = Vec::new();
            for (k, stage) in ["import", "reconstruct", "enhance", "evaluate"].into_iter().enumerate() {
                let state = State::Waiting(Vec::new());
                let mut node = node(stage, &name, variant, state, 10.0);
                node.needs = if k > 0 { vec![at + k - 1] } else { Vec::new() };
                if k < 2 && variant != "full" {
                    (node.shared_with, node.needs) = (Some("full".to_string()), vec![first + k]);
                }
                own.push(node);
            }
            nodes.extend(own);
        }
    }
    Plan { pipeline: "ablation".to_string(), nodes, seconds: 0.0 }
}

#[test]
fn what_is_more_than_an_array_may_hold_is_cut_and_no_more_run_at_once() {
    let site = Site { largest_array: 3, at_once: 4, ..site() };
    let jobs = jobs::of(&ablation(7), &registry(), &site, Layout::Stages, None).expect("jobs");
    let of = |stage: &str| jobs.iter().filter(|j| j.name.starts_with(stage)).collect::<Vec<_>>();
    // There are seven trainings, not twenty-one, and four run at the same time.
    let trainings = of("reconstruct");
    assert_eq!(trainings.iter().map(|j| j.count()).collect::<Vec<_>>(), [3, 3, 1]);
    assert_eq!(trainings.iter().map(|j| j.at_once).sum::<usize>(), 4);
    assert_eq!(trainings[2].tasks, Some(vec![0]));
    for stage in ["import", "reconstruct", "enhance", "evaluate"] {
        let tasks: usize = of(stage).iter().map(|j| j.count()).sum();
        assert_eq!(tasks, if ["import", "reconstruct"].contains(&stage) { 7 } else { 21 }, "{stage}");
        // Arrays beyond the limit of concurrent tasks wait for others.
        let waits = of(stage).iter().filter(|j| j.after.iter().any(|a| matches!(a, After::Over(_)))).count();
        assert_eq!(waits, of(stage).len().saturating_sub(4), "{stage}");
    }
    // The predecessor of every task has the same number in the array that it waits for.
    for job in &jobs[..jobs.len() - 1] {
        for after in &job.after {
            if let After::Same(of) = after {
                let there = jobs[*of].tasks.as_ref().expect("an array");
                assert!(
                    job.tasks.as_ref().expect("an array").iter().all(|n| there.contains(n)),
                    "{}",
                    job.name
                );
            }
        }
    }
    let workers = jobs::of(&plan(), &registry(), &site, Layout::Workers, Some(9)).expect("jobs");
    assert_eq!(workers[0].count(), 3);
}

/// A folder with commands that stand in for `use3d` and Slurm's.
struct StandIn {
    dir: tempfile::TempDir,
}

impl StandIn {
    fn new(use3d: &str) -> Self {
        let stand_in = Self { dir: tempfile::tempdir().expect("folder") };
        stand_in.command("use3d", use3d);
        stand_in.command("scontrol", "echo \"$@\" >> scontrol.log; exit 1");
        stand_in
    }

    fn command(&self, name: &str, body: &str) {
        let path = self.dir.path().join(name);
        fs::write(&path, format!("#!/bin/bash\ncd {}\n{body}\n", self.dir.path().display()))
            .expect("written");
        fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).expect("executable");
    }

    /// The script of a job, run in this folder.
    fn script(&self, job: &Job) -> Command {
        let mut own = submission();
        own.place = self.dir.path().to_path_buf();
        own.folder = self.dir.path().join("submit folder");
        let site = Site { setup: Vec::new(), ..site() };
        slurm::write(std::slice::from_ref(job), &own, &site).expect("written");
        let path = format!("{}:{}", self.dir.path().display(), std::env::var("PATH").unwrap_or_default());
        let mut command = Command::new("bash");
        command.arg(own.script_path(job)).env("PATH", path);
        command.envs([("SLURM_ARRAY_JOB_ID", "7"), ("SLURM_JOB_ID", "9"), ("SLURM_ARRAY_TASK_ID", "1")]);
        command.env("SLURM_CPUS_PER_TASK", "3").stdout(Stdio::null());
        command
    }

    fn read(&self, name: &str) -> String {
        fs::read_to_string(self.dir.path().join(name)).unwrap_or_default()
    }
}

#[test]
fn a_task_runs_its_own_scene_and_tells_how_it_ended() {
    let stages = of(Layout::Stages);
    for code in [0, 1, 2, 130] {
        let stand_in = StandIn::new(&format!("printf '%s\\n' \"$@\" > words; exit {code}"));
        let status = stand_in.script(&stages[4]).status().expect("a shell");
        assert_eq!(status.code(), Some(code));
        let words = stand_in.read("words");
        let words: Vec<&str> = words.lines().collect();
        assert_eq!(words[..3], ["--threads", "3", "run"]);
        assert_eq!(words[words.len() - 2..], ["--only", "Curaçao north@full"], "{words:?}");
        assert_eq!(stand_in.read("scontrol.log"), "");
    }
}

/// HyperQueue starts no task that waits for a failed one.
#[test]
fn what_only_finish_waits_for_keeps_it_from_nothing_in_hyperqueue() {
    let file = hyperqueue::file(&of(Layout::Workers), &submission());
    let starts: Vec<&str> = file.lines().filter(|line| line.starts_with("command = ")).collect();
    let (workers, finish) = starts.split_at(4);
    assert!(workers.iter().all(|line| line.contains("task.sh\", \"afterany\", \"--threads\"")), "{file}");
    assert!(finish.len() == 1 && finish[0].contains("task.sh\", \"afterok\", \"--threads\""), "{file}");
    assert!(!hyperqueue::ends_with_a_failure(&of(Layout::Workers)));
    assert!(hyperqueue::ends_with_a_failure(&of(Layout::Stages)));

    for (setup, code, shown) in [("", 0, 0), ("", 1, 0), ("", 2, 0), ("", 130, 130), ("set -e", 1, 0)] {
        let stand_in = StandIn::new(&format!("printf '%s\\n' \"$@\" > words; exit {code}"));
        let mut own = submission();
        own.place = stand_in.dir.path().to_path_buf();
        let site = Site { setup: vec![setup.to_string()], ..site() };
        fs::write(stand_in.dir.path().join("task.sh"), hyperqueue::script(&own, &site)).expect("written");
        let path = format!("{}:{}", stand_in.dir.path().display(), std::env::var("PATH").unwrap_or_default());
        let ended = |after: &str| {
            let mut command = Command::new("bash");
            command
                .arg(stand_in.dir.path().join("task.sh"))
                .args([after, "run", "two words"])
                .env("PATH", &path);
            let status = command.stdout(Stdio::null()).stderr(Stdio::null()).status();
            assert_eq!(stand_in.read("words"), "run\ntwo words\n");
            status.expect("a shell").code()
        };
        assert_eq!((ended("afterany"), ended("afterok")), (Some(shown), Some(code)), "{setup}");
    }
}

#[test]
fn a_task_out_of_time_is_queued_again_but_not_for_ever() {
    let stages = of(Layout::Stages);
    let stand_in = StandIn::new("exit 75");
    assert_eq!(stand_in.script(&stages[4]).status().expect("a shell").code(), Some(75));
    assert_eq!(stand_in.script(&stages[14]).status().expect("a shell").code(), Some(75));
    assert_eq!(stand_in.read("scontrol.log"), "requeue 7_1\nrequeue 9\n");
    let often = stand_in.script(&stages[4]).env("SLURM_RESTART_COUNT", "50").status().expect("a shell");
    assert_eq!((often.code(), stand_in.read("scontrol.log").lines().count()), (Some(75), 2));
}

#[test]
fn the_signal_before_the_limit_reaches_the_run_and_its_exit_code_the_scheduler() {
    let stages = of(Layout::Stages);
    for (signal, code) in [("USR1", 75), ("TERM", 130)] {
        let body = format!(
            "trap 'echo {signal} > heard; exit {code}' {signal}; echo > ready; while :; do sleep 0.02; done"
        );
        let stand_in = StandIn::new(&body);
        let mut child = stand_in.script(&stages[4]).spawn().expect("a shell");
        while stand_in.read("ready").is_empty() {
            assert!(child.try_wait().expect("a state").is_none(), "ended before it was told to");
            std::thread::sleep(Duration::from_millis(5));
        }
        let kill = Command::new("kill").args([format!("-{signal}"), child.id().to_string()]).status();
        assert!(kill.expect("kill").success());
        let status = child.wait().expect("ends");
        assert_eq!((status.code(), stand_in.read("heard").trim()), (Some(code), signal));
        assert_eq!(stand_in.read("scontrol.log"), if code == 75 { "requeue 7_1\n" } else { "" });
    }
}
