//! Tests `use3d submit` with commands that stand in for Slurm's: they run each submitted job at once, with
//! real processes that share a cache.

mod growing;
mod many;
mod tiny;

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Output;

use many::Many;

/// Runs the tasks of a submitted script in parallel, then prints the job's number.
const SBATCH: &str = r#"
echo "$*" >> "$here/sbatch.log"
script="${!#}"
number=$(( $(cat "$here/number" 2>/dev/null || echo 100) + 1 )); echo "$number" > "$here/number"
array=$(sed -n 's/^#SBATCH --array=\(.*\)%.*/\1/p' "$script")
export SLURM_JOB_ID=$number SLURM_CPUS_PER_TASK=1 SLURM_ARRAY_JOB_ID=$number
if [ -n "$array" ]; then
  for range in ${array//,/ }; do
    for task in $(seq "${range%-*}" "${range#*-}"); do
      SLURM_ARRAY_TASK_ID=$task bash "$script" >> "$here/tasks.log" 2>&1 &
    done
  done
  wait
else
  bash "$script" >> "$here/tasks.log" 2>&1
fi
echo "$number;cluster"
"#;

fn stand_ins(many: &Many) -> String {
    let folder = many.at("bin");
    fs::create_dir_all(&folder).expect("folder");
    let write = |name: &str, body: &str| {
        let path = folder.join(name);
        fs::write(&path, format!("#!/bin/bash\nhere={}\n{body}", folder.display())).expect("written");
        fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).expect("executable");
    };
    write("sbatch", SBATCH);
    write("squeue", "cat \"$here/queue\" 2>/dev/null; exit 0\n");
    write("scancel", "echo \"$*\" >> \"$here/scancel.log\"\n");
    write("scontrol", "exit 1\n");
    format!("{}:{}", folder.display(), std::env::var("PATH").unwrap_or_default())
}

fn said(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

fn read(path: &Path) -> String {
    fs::read_to_string(path).unwrap_or_default()
}

#[test]
fn what_is_handed_over_ends_like_a_run_of_one_process_and_again_means_only_what_is_missing() {
    let many = Many::new(&["s1".to_string(), "s2".to_string()]);
    let whole = many.alone();
    let path = stand_ins(&many);
    let site = format!("command = \"{}\"\ncpus = 1\nat_once = 3\n", env!("CARGO_BIN_EXE_use3d"));
    fs::write(many.at("cluster.toml"), site).expect("written");
    let submit = |cache: &str, extra: &[&str]| {
        let mut command = many.command(&["submit", "slurm"], cache);
        command.args(["--cluster", "cluster.toml", "--out"]).arg(format!("out-{cache}")).args(extra);
        let output = command.env("PATH", &path).output().expect("the command starts");
        (output.status.code(), said(&output))
    };
    for layout in ["workers", "stages"] {
        let (code, text) = submit(layout, &["--layout", layout, "--dry-run"]);
        assert_eq!(code, Some(0), "{text}");
        assert!(
            text.contains("#SBATCH --time=") && !many.at(&format!("out-{layout}-submit")).exists(),
            "{text}"
        );
        let (code, text) = submit(layout, &["--layout", layout]);
        let log = read(&many.at("bin/tasks.log"));
        assert_eq!(code, Some(0), "{text}{log}");
        assert!(text.contains("submitted finish as job") && text.contains("use3d status"), "{text}");
        assert!(many.artifacts(layout) == whole, "{layout}: {text}{log}");
        let delivered = many.scores(format!("out-{layout}").as_ref());
        assert!(delivered.len() == 2 && delivered == many.scores("out-alone".as_ref()), "{log}");
        assert_eq!(fs::read_dir(many.at(layout).join("v1/leases")).expect("leases").count(), 0, "{log}");

        let (code, text) = submit(layout, &["--layout", layout]);
        assert!(code == Some(0) && text.contains("nothing to submit"), "{text}");
    }
    // Only the lost artifact of one scene is submitted again.
    let lost =
        fs::read_dir(many.at("stages/v1/artifacts/evaluate")).expect("two").flatten().next().expect("one");
    fs::remove_dir_all(lost.path()).expect("removed");
    let (code, text) = submit("stages", &["--layout", "stages"]);
    assert_eq!(code, Some(0), "{text}");
    assert_eq!(read(&many.at("out-stages-submit/evaluate.tasks")).lines().count(), 1);
    assert!(!text.contains("submitted reconstruct"), "{text}");
    assert!(many.artifacts("stages") == whole);

    // While a job is in the queue, nothing is submitted twice by accident.
    fs::remove_dir_all(many.at("stages/v1/artifacts/evaluate")).expect("removed");
    fs::write(many.at("bin/queue"), "101\n").expect("written");
    let (code, text) = submit("stages", &["--layout", "stages"]);
    assert!(code == Some(2) && text.contains("still in the queue") && text.contains("--again"), "{text}");
    // If a scheduler refuses a later job, the earlier ones are cancelled.
    fs::write(
        many.at("bin/sbatch"),
        "#!/bin/bash\n[ -e once ] && { echo 'QOSMaxSubmitJob' >&2; exit 1; }; touch once; echo 7\n",
    )
    .expect("written");
    let (code, text) = submit("stages", &["--layout", "stages", "--again"]);
    assert!(code == Some(1) && text.contains("QOSMaxSubmitJob"), "{text}");
    assert_eq!(read(&many.at("bin/scancel.log")), "7\n");
    // If that fails, the record still has the earlier ones, for `use3d cancel`.
    fs::remove_file(many.at("once")).expect("removed");
    let recorded = || read(&many.at("out-stages-submit/submitted.json"));
    assert!(!recorded().is_empty() && !recorded().contains("\"7\""), "{}", recorded());
    fs::write(many.at("bin/scancel"), "#!/bin/bash\nexit 1\n").expect("written");
    let (code, text) = submit("stages", &["--layout", "stages", "--again"]);
    assert!(code == Some(1) && text.contains("QOSMaxSubmitJob"), "{text}");
    assert!(recorded().contains("\"7\""), "{}", recorded());
}

#[test]
fn tasks_get_every_setting_the_engine_too_and_status_is_asked_with_the_same() {
    let many = Many::new(&["s1".to_string()]);
    let path = stand_ins(&many);
    fs::write(many.at("bin/sbatch"), "#!/bin/bash\necho 7\n").expect("written");
    // This machine has no such card, and need not have it.
    let submit_on = |engine: &str, extra: &[&str]| {
        let mut command = many.command(&["submit", "slurm"], "told");
        let output = command.args(["--engine", engine]).args(extra).env("PATH", &path).output();
        said(&output.expect("the command starts"))
    };
    let submit = |extra: &[&str]| submit_on("gpu:vega", extra);
    let engines =
        "--set reconstruct.engine=gpu:vega --set targets.engine=gpu:vega --set enhance.engine=gpu:vega";
    let text = submit_on("auto", &["--dry-run"]);
    assert!(text.contains("`reconstruct.engine` is auto") && text.contains("write gpu or cpu"), "{text}");
    let text = submit(&["--dry-run"]);
    assert!(text.lines().any(|line| line.contains(" run ") && line.contains(engines)), "{text}");
    let text = submit(&[]);
    let status = text.lines().find(|line| line.starts_with("to see their progress")).unwrap_or_default();
    assert!(status.contains("use3d status") && status.contains(engines), "{text}");
}

/// Runs `use3d submit` with these arguments and the stand-ins; returns exit code and output.
fn submit(many: &Many, path: &str, scheduler: &str, cache: &str, extra: &[&str]) -> (Option<i32>, String) {
    let mut command = many.command(&["submit", scheduler], cache);
    let output = command.args(extra).env("PATH", path).output().expect("the command starts");
    (output.status.code(), said(&output))
}

#[test]
fn what_was_killed_in_one_task_is_left_to_the_next_submission_unless_the_scheduler_starts_it_again() {
    let many = Many::new(&["s1".to_string()]);
    let run = |job: &str, attempt: &str, submission: &str| {
        let mut command = many.command(&["run", "--cache-only", "--until", "reconstruct"], "cache");
        command.args(["--set", "reconstruct.iterations=4000"]);
        command.env("SLURM_JOB_ID", job).env("SLURM_RESTART_COUNT", attempt);
        command.env("USE3D_SUBMISSION", submission);
        command.stderr(std::process::Stdio::piped()).stdout(std::process::Stdio::piped());
        command
    };
    let log = many.at("cache/v1/logs/many/s1/_/reconstruct.log");
    let mut killed = run("1", "0", "a").spawn().expect("the command starts");
    while !log.exists() {
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    killed.kill().expect("killed");
    killed.wait().expect("gone");
    let first = read(&log);
    let output = run("2", "0", "a").output().expect("the command starts");
    assert!(output.status.success() && read(&log) == first, "{}", said(&output));
    assert!(said(&output).contains("left to slurm 1, where it was killed"), "{}", said(&output));
    // Slurm starts a task again whose machine was lost; another submission asks for more memory.
    for (job, attempt, submission) in [("1", "1", "a"), ("3", "0", "b")] {
        let mut child = run(job, attempt, submission).spawn().expect("the command starts");
        while read(&log) == first || read(&log).is_empty() {
            assert!(child.try_wait().expect("a state").is_none(), "{job}: it ended");
            std::thread::sleep(std::time::Duration::from_millis(5));
        }
        child.kill().expect("killed");
        child.wait().expect("gone");
        fs::write(&log, &first).expect("written");
    }
}

#[test]
fn arguments_of_a_site_that_change_results_are_refused_and_workers_get_what_the_largest_stage_needs() {
    let many = Many::new(&["s1".to_string()]);
    let submit = |site: &str| {
        fs::write(many.at("cluster.toml"), site).expect("written");
        let words = ["--cluster", "cluster.toml", "--dry-run"];
        submit(&many, "/nowhere", "slurm", "cache", &words)
    };
    for (arguments, words) in [
        (r#"["--set", "reconstruct.iterations=13"]"#, "changes results"),
        (r#"["--set", "reconstruct.engine=auto"]"#, "changes results"),
        (r#"["--fly"]"#, "unexpected argument '--fly'"),
    ] {
        let (code, text) = submit(&format!("[stage.reconstruct]\narguments = {arguments}"));
        assert!(code == Some(2) && text.contains("`stage.reconstruct.arguments`: "), "{text}");
        assert!(text.contains("cluster.toml: ") && text.contains(words), "{text}");
    }
    let (code, text) = submit(
        "cpus = 2\n[stage.reconstruct]\npartition = \"gpu\"\nmemory = \"24GB\"\ntime = \"6h\"\n\
         options = [\"--gres=gpu:1\"]\narguments = [\"--set\", \"reconstruct.checkpoint_minutes=7\"]\n\
         [stage.import]\ncpus = 8\n[stage.run]\narguments = [\"--verbose\"]\n",
    );
    let workers = text.split("--- sbatch").nth(1).unwrap_or_default();
    for line in ["--partition=gpu", "--cpus-per-task=8", "--time=6:00:00", "--gres=gpu:1", " --verbose"] {
        assert!(code == Some(0) && workers.contains(line), "{line}: {text}");
    }
    assert!(text.contains("24000 MB"), "{text}");
    let (code, text) =
        submit("[stage.reconstruct]\npartition = \"gpu\"\n[stage.import]\npartition = \"short\"\n");
    assert!(code == Some(2) && text.contains("gpu (reconstruct), short (import)"), "{text}");
}

#[test]
fn what_has_no_capture_is_said_and_is_no_success() {
    let many = Many::new(&["s1".to_string(), "gone".to_string()]);
    fs::remove_dir_all(many.at("gone")).expect("removed");
    let path = stand_ins(&many);
    // Without a `command`, tasks run the program that submits.
    let words = ["-q"];
    let (code, text) = submit(&many, &path, "slurm", "cache", &[&words[..], &["--dry-run"]].concat());
    assert!(code == Some(1) && text.contains("warning: gone import: "), "{text}");
    // The rest is submitted and done.
    let (code, text) = submit(&many, &path, "slurm", "cache", &words);
    let rest = text.contains("submitted finish as job")
        && text.contains("error: the stages that need them are not submitted");
    assert!(code == Some(1) && rest && text.contains("1 input is missing, see above"), "{text}");
    assert_eq!(many.scores("use3d-out/many".as_ref()).len(), 1);
    // If nothing is left to submit, the message must not claim that everything is done.
    let alone = "name = \"many\"\n[[scene]]\nname = \"gone\"\ncapture = \"gone\"\n";
    fs::write(many.at("alone.toml"), alone).expect("written");
    let mut command = tiny::command();
    command.args(["-q", "submit", "slurm", "alone.toml", "--cache", "cache"]).current_dir(many.at(""));
    let output = command.env("PATH", &path).output().expect("the command starts");
    let text = said(&output);
    assert!(output.status.code() == Some(1) && text.contains("warning: gone import: "), "{text}");
    let end = "error: nothing can be submitted: 1 input is missing, see above";
    assert!(text.contains(end) && !text.contains("nothing to submit: all"), "{text}");
}

#[test]
fn tasks_get_the_variables_that_the_pipeline_names_and_no_secrets() {
    let many = Many::new(&["s1".to_string()]);
    let text = fs::read_to_string(many.at("many.toml")).expect("a file");
    let named = "capture = \"${REEF_DATA}/s1\"\n[[scene]]\nname = \"s2\"\ncapture = \"${REEF_TOKEN}/s1\"";
    fs::write(many.at("many.toml"), text.replace("capture = \"s1\"", named)).expect("written");
    let here = many.at("").to_string_lossy().into_owned();
    for scheduler in ["slurm", "hq"] {
        let dry_run = |remote: &str| {
            let mut command = many.command(&["submit", scheduler, "--dry-run"], "cache");
            command.env("REEF_DATA", format!("{here}/my data/..")).env("REEF_TOKEN", &here);
            command
                .env("USE3D_REMOTE", remote)
                .env("AWS_SECRET_ACCESS_KEY", "hidden")
                .env("UNUSED", "unused");
            let output = command.output().expect("the command starts");
            (output.status.code(), said(&output))
        };
        fs::create_dir_all(many.at("my data")).expect("folder");
        let (code, text) = dry_run("/mnt/share/use3d");
        assert_eq!(code, Some(0), "{text}");
        let scripts = text.matches("#!/bin/bash").count();
        for line in [
            format!("export REEF_DATA='{here}/my data/..'"),
            "export USE3D_REMOTE=/mnt/share/use3d".to_string(),
            // Other networks than the plan uses would give stages other keys, and the work would never end.
            "unset USE3D_MODELS".to_string(),
        ] {
            assert_eq!(text.lines().filter(|l| **l == line).count(), scripts, "{line}: {text}");
        }
        assert!(text.contains("warning: the environment variable REEF_TOKEN is not written"), "{text}");
        assert!(
            !text.contains("export REEF_TOKEN") && !text.contains("hidden") && !text.contains("unused"),
            "{text}"
        );
        let (code, text) = dry_run("s3://AKIA:password@bucket/use3d");
        assert!(code == Some(2) && text.contains("USE3D_REMOTE: ") && !text.contains("password"), "{text}");
    }
}

#[test]
fn words_without_effect_and_answers_that_are_none_are_refused() {
    let many = Many::new(&["s1".to_string()]);
    let path = stand_ins(&many);
    let stages = ["--layout", "stages", "--workers", "3"];
    let (code, text) = submit(&many, &path, "slurm", "cache", &stages);
    assert!(code == Some(2) && text.contains("--workers 3: --layout stages has a task for every"), "{text}");
    let (code, text) = submit(&many, &path, "slurm", "cache", &["--cluster", "nowhere.toml"]);
    assert!(
        code == Some(2) && text.contains("nowhere.toml: ") && text.contains("--cluster expects"),
        "{text}"
    );
    // Without a scheduler the scripts are written all the same.
    let scripts = many.at("use3d-out/many-submit");
    for (scheduler, file) in [("slurm", "workers.sbatch"), ("hq", "job.toml")] {
        let (code, text) = submit(&many, "/nowhere", scheduler, "cache", &[]);
        assert!(code == Some(1) && text.contains(&scripts.display().to_string()), "{text}");
        assert!(!text.contains("--dry-run") && scripts.join(file).is_file(), "{text}");
    }
    // The reply to the second job is not a number: the first one is cancelled.
    for answer in ["", "Welcome to reef", "7b"] {
        let body = format!(
            "#!/bin/bash\n[ -e once ] && {{ echo '{answer}'; exit 0; }}; touch once; echo '7;reef'\n"
        );
        fs::write(many.at("bin/sbatch"), body).expect("written");
        let (code, text) = submit(&many, &path, "slurm", "cache", &[]);
        assert!(
            code == Some(1) && text.contains("expected the number of a job") && text.contains(answer),
            "{text}"
        );
        assert!(!text.contains("submitted "), "{text}");
        assert_eq!(read(&many.at("bin/scancel.log")), "7\n");
        for file in ["once", "bin/scancel.log"] {
            fs::remove_file(many.at(file)).expect("removed");
        }
    }
}

#[test]
fn hyperqueue_is_asked_whether_the_last_job_is_over() {
    let many = Many::new(&["s1".to_string()]);
    let path = stand_ins(&many);
    // The output of the real program with `--output-mode quiet`.
    let body = "#!/bin/bash\necho \"$*\" >> hq.log\ncase \"$*\" in\n*'job list') cat open; exit 0 ;;\n*'worker list') cat workers; exit 0 ;;\n*) echo 12 ;;\nesac\n";
    fs::write(many.at("bin/hq"), body).expect("written");
    fs::set_permissions(many.at("bin/hq"), fs::Permissions::from_mode(0o755)).expect("executable");
    fs::write(many.at("cluster.toml"), "partition = \"cpu\"\n[stage.run]\noptions = [\"--gres=gpu:1\"]\n")
        .expect("written");
    // A worker that has ended, one with too few processors, and one that lives too short.
    let worker = |cpus: &str, limit: &str, ended: &str| {
        format!(
            r#"{{"id": 1, "configuration": {{"hostname": "node", "time_limit": {limit}, "resources": {{"resources":
            [{{"name": "cpus", "kind": "list", "values": [{cpus}]}}, {{"name": "mem", "kind": "sum", "size": 32000}}]}}}},
            "started": "2026-11-29T08:00:00Z", "ended": {ended}}}"#
        )
    };
    let four = r#""0", "1", "2", "3""#;
    let small = [worker(four, "null", "{}"), worker("\"0\"", "null", "null"), worker(four, "60.0", "null")];
    fs::write(many.at("workers"), format!("[{}]", small.join(","))).expect("written");
    let (code, text) = submit(&many, &path, "hq", "cache", &["--cluster", "cluster.toml"]);
    assert!(code == Some(0) && text.contains("submitted many as job 12"), "{text}");
    let warned = "warning: no worker of now has cpus = 4, mem = 7630 and 4:00:00 for workers, finish;";
    assert!(text.contains(warned) && text.contains("hq worker start"), "{text}");
    fs::write(many.at("workers"), format!("[{},{}]", small.join(","), worker(four, "null", "null")))
        .expect("written");
    let (_, text) = submit(&many, &path, "hq", "cache", &["--cluster", "cluster.toml"]);
    assert!(!text.contains("no worker of now"), "{text}");
    fs::write(many.at("workers"), "[]").expect("written");
    let (code, text) = submit(&many, &path, "hq", "cache", &["--cluster", "cluster.toml"]);
    assert!(code == Some(0) && text.contains("submitted many as job 12"), "{text}");
    assert!(text.contains("HyperQueue has no setting for partition, stage.run.options"), "{text}");
    assert!(!text.contains("no worker of now"), "{text}");
    assert!(!text.contains("HyperQueue starts no task"), "{text}");
    fs::write(many.at("open"), "3 RUNNING\n12 WAITING\n").expect("written");
    let (code, text) = submit(&many, &path, "hq", "cache", &[]);
    assert!(code == Some(2) && text.contains("12 (many)") && text.contains("hq job cancel"), "{text}");
    let (code, text) = submit(&many, &path, "hq", "cache", &["--again", "--layout", "stages"]);
    assert!(code == Some(0) && text.contains("not even `finish`; then run: use3d run "), "{text}");
    fs::write(many.at("open"), "").expect("written");
    assert_eq!(submit(&many, &path, "hq", "cache", &[]).0, Some(0));
    let asked = read(&many.at("hq.log"));
    assert_eq!(asked.lines().filter(|line| line.contains("job submit-file")).count(), 5, "{asked}");
}

#[test]
fn a_wrong_site_file_is_said_before_anything_is_written() {
    let many = Many::new(&["s1".to_string()]);
    for (text, words) in
        [("cpus = 0", "`cpus` is 0"), ("[stage.fly]", "no such stage"), ("nodes = 3", "nodes")]
    {
        fs::write(many.at("cluster.toml"), text).expect("written");
        let mut command = many.command(&["submit", "hq"], "cache");
        let output = command.args(["--cluster", "cluster.toml"]).output().expect("the command starts");
        let said = said(&output);
        assert!(
            output.status.code() == Some(2) && said.contains("cluster.toml: ") && said.contains(words),
            "{said}"
        );
    }
    assert!(!many.at("use3d-out").exists());
}

#[test]
fn a_run_leaves_when_its_time_is_over_or_slurm_says_so_and_the_next_goes_on() {
    let many = Many::new(&["s1".to_string()]);
    let whole = many.alone();
    let run = |extra: &[&str]| {
        let mut command = many.command(&["-q", "run", "--cache-only"], "cache");
        command.args(extra);
        command
    };
    // Too little time, even on a very fast machine.
    let output = run(&["--max-time", "0.05s"]).output().expect("the command starts");
    assert_eq!(output.status.code(), Some(75), "{}", said(&output));
    assert!(said(&output).contains("time limit reached"), "{}", said(&output));
    // After a signal during a training, its checkpoint exists, and the training resumes from it.
    let long = ["--set", "reconstruct.iterations=4000"];
    let mut child =
        run(&long).stderr(std::process::Stdio::null()).stdout(std::process::Stdio::null()).spawn();
    let child = child.as_mut().expect("the command starts");
    let log = many.at("cache/v1/logs/many/s1/_/reconstruct.log");
    while !log.exists() {
        assert!(child.try_wait().expect("a state").is_none(), "ended before it was told to");
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    let told = std::process::Command::new("kill").args(["-USR1", &child.id().to_string()]).status();
    assert!(told.expect("kill").success());
    assert_eq!(child.wait().expect("ends").code(), Some(75));
    let output = run(&[]).output().expect("the command starts");
    assert!(output.status.success(), "{}", said(&output));
    assert!(many.artifacts("cache") == whole);
    let output = run(&["--only", "s1", "--until-empty"]).output().expect("the command starts");
    assert!(output.status.success(), "{}", said(&output));
    let output = run(&["--only", "s2"]).output().expect("the command starts");
    assert!(output.status.code() == Some(2) && said(&output).contains("there are: s1"), "{}", said(&output));
    assert!(!many.at("use3d-out").exists(), "nothing was delivered");
}

/// Names with a line break are refused: the shell would execute the rest of the name as a line of the script.
#[test]
fn no_place_of_a_script_has_a_line_break() {
    let many = Many::new(&["s1".to_string()]);
    let path = stand_ins(&many);
    let wrong = "o\ntouch PWNED #";
    let mut command = many.command(&["submit", "slurm"], "cache");
    let output = command.args(["--dry-run", "--out", wrong]).env("PATH", &path).output();
    let output = output.expect("the command starts");
    assert!(
        output.status.code() == Some(2) && said(&output).contains("control character"),
        "{}",
        said(&output)
    );
    // The working folder is checked too.
    let folder = many.at(wrong);
    fs::create_dir(&folder).expect("a folder");
    let mut command = many.command(&["submit", "slurm"], "cache");
    let output = command.args(["--dry-run", "--out"]).arg(many.at("out")).current_dir(&folder);
    let output = output.env("PATH", &path).output().expect("the command starts");
    assert!(
        output.status.code() == Some(2) && said(&output).contains("control character"),
        "{}",
        said(&output)
    );
}

/// Writes a stand-in for a command.
fn stand_in(many: &Many, name: &str, body: &str) {
    let path = many.at("bin").join(name);
    fs::write(&path, format!("#!/bin/bash\n{body}\n")).expect("written");
    fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).expect("executable");
}

#[test]
fn every_submitted_job_is_recorded_at_once_and_all_can_be_cancelled() {
    let many = Many::new(&["s1".to_string()]);
    let path = stand_ins(&many);
    let cancel = |words: &[&str]| {
        let mut command = tiny::command();
        command.args(["cancel"]).arg(many.at("many.toml")).args(words).current_dir(many.at(""));
        let output = command.env("PATH", &path).output().expect("the command starts");
        (output.status.code(), said(&output))
    };
    let (code, text) = cancel(&[]);
    assert!(code == Some(2) && text.contains("nothing was submitted from there"), "{text}");
    assert!(!many.at("use3d-out").exists(), "cancelling makes no folder");
    // The second job finds the first one in the record, so a `submit` that is killed leaves no unknown job.
    let record = many.at("use3d-out/many-submit/submitted.json");
    let body = format!(
        "cp {} {} 2>/dev/null; n=$(cat n 2>/dev/null || echo 6); echo $((n + 1)) | tee n",
        record.display(),
        many.at("seen").display()
    );
    stand_in(&many, "sbatch", &body);
    let (code, text) = submit(&many, &path, "slurm", "cache", &[]);
    assert_eq!(code, Some(0), "{text}");
    let seen: serde_json::Value = serde_json::from_str(&read(&many.at("seen"))).expect("a record");
    assert_eq!(
        (&seen["scheduler"], &seen["jobs"]),
        (&"slurm".into(), &serde_json::json!([["workers", "7"]]))
    );
    let kept = many.at("use3d-out/many-submit/pipeline.toml");
    assert_eq!(read(&kept), read(&many.at("many.toml")));
    // Slurm forgets jobs that ended, and refuses to cancel a job that it does not know.
    let (code, text) = cancel(&[]);
    assert!(code == Some(0) && text.contains("nothing to cancel: all jobs"), "{text}");
    assert_eq!(read(&many.at("bin/scancel.log")), "");
    let unknown = "slurm_load_jobs error: Invalid job id specified";
    stand_in(&many, "squeue", &format!("[ \"${{!#}}\" = 7 ] && {{ echo '{unknown}' >&2; exit 1; }}; echo 8"));
    let (code, text) = cancel(&[]);
    assert!(code == Some(0) && text.contains("cancelled 8;"), "{text}");
    stand_in(&many, "squeue", "echo 1");
    let (code, text) = cancel(&[]);
    assert!(code == Some(0) && text.contains("cancelled 7, 8;"), "{text}");
    assert_eq!(read(&many.at("bin/scancel.log")), "8\n7 8\n");
    stand_in(&many, "scancel", "echo 'Access denied' >&2; exit 1");
    let (code, text) = cancel(&["--out", "use3d-out/many"]);
    assert!(code == Some(1) && text.contains("Access denied"), "{text}");
}

#[test]
fn the_sites_limit_of_arrays_is_asked_for_and_jobs_that_never_start_are_named() {
    let many = Many::new(&["s1".to_string(), "s2".to_string(), "s3".to_string()]);
    let path = stand_ins(&many);
    // Slurm counts task numbers from 0, so its limit of 3 permits the numbers 0 to 2. The shorter limit wins.
    let arrays = |cluster: &str| {
        fs::write(many.at("cluster.toml"), cluster).expect("written");
        let words = ["--layout", "stages", "--dry-run", "--cluster", "cluster.toml"];
        let (code, text) = submit(&many, &path, "slurm", "cache", &words);
        assert_eq!(code, Some(0), "{text}");
        let lines = text.lines().skip_while(|line| !line.contains("--job-name=many-reconstruct"));
        let array = lines.filter_map(|line| line.strip_prefix("#SBATCH --array=")).next().expect("an array");
        array.to_string()
    };
    assert_eq!(arrays(""), "0-2%8");
    stand_in(&many, "scontrol", "echo 'MaxArrayTasks = 9'; echo 'MaxArraySize            = 3'");
    assert_eq!(arrays(""), "0-1%4");
    assert_eq!(arrays("largest_array = 1"), "0%3");
    stand_in(&many, "sbatch", "n=$(cat n 2>/dev/null || echo 6); echo $((n + 1)) | tee n");
    // Slurm gives a reason only when it has examined a job.
    let pending = "case \"$*\" in *' %r '*) [ -e seen ] && echo '7_[0-2] (PartitionConfig)' || echo '7_[0-2] (None)'; \
                   touch seen; echo '8 (Dependency)' ;; esac; exit 0";
    stand_in(&many, "squeue", pending);
    let (code, text) = submit(&many, &path, "slurm", "cache", &["-q"]);
    let warned = "warning: job 7_[0-2] can never start (PartitionConfig)";
    assert!(code == Some(0) && text.contains(warned) && !text.contains("job 8 can never"), "{text}");
    // A request that Slurm refuses at once is said with its size; what the site states is what is asked for.
    stand_in(&many, "squeue", "exit 0");
    let refusal = "sbatch: error: Batch job submission failed: Requested node configuration is not available";
    stand_in(&many, "sbatch", &format!("echo '{refusal}' >&2; exit 1"));
    fs::write(many.at("cluster.toml"), "memory = \"1GB\"\ntime = \"1h\"\n").expect("written");
    let (code, text) = submit(&many, &path, "slurm", "cache", &["--cluster", "cluster.toml"]);
    let asked =
        "not available; the job asks for 4 processors, 1000 MB and 1:00:00; if no node has these, write";
    assert!(code == Some(1) && text.contains(asked) && text.contains("--cluster FILE"), "{text}");
}

/// A task computes what was planned at its submission, or nothing.
#[test]
fn a_task_refuses_a_pipeline_that_was_edited_since() {
    let many = Many::new(&["s1".to_string()]);
    let path = stand_ins(&many);
    let site = format!("command = \"{}\"\ncpus = 1\n", env!("CARGO_BIN_EXE_use3d"));
    fs::write(many.at("cluster.toml"), site).expect("written");
    let text = read(&many.at("many.toml"));
    // The file is edited while the tasks wait.
    let keep = read(&many.at("bin/sbatch")).replace(
        "script=",
        &format!("sed -i 's/seed = 42/seed = 43/' {}\nscript=", many.at("many.toml").display()),
    );
    fs::write(many.at("bin/sbatch"), keep).expect("written");
    let words = ["--cluster", "cluster.toml", "--layout", "stages"];
    submit(&many, &path, "slurm", "cache", &words);
    let log = read(&many.at("bin/tasks.log"));
    assert!(log.contains("this is not the submitted pipeline"), "{log}");
    assert!(many.artifacts("cache").is_empty(), "{log}");
    // The same scripts work again with the submitted text.
    fs::write(many.at("many.toml"), text).expect("written");
    let script = many.at("use3d-out/many-submit/import.sbatch");
    let output = std::process::Command::new("bash").arg(script).env("SLURM_ARRAY_TASK_ID", "0").output();
    let output = output.expect("a shell");
    assert!(output.status.success() && !many.artifacts("cache").is_empty(), "{}", said(&output));
}

/// Slurm sends the signal of a cancelled, preempted or requeued task to every process of the task: to the
/// script, which passes it on, and to the command itself.
#[test]
fn a_cancelled_task_saves_its_checkpoint_and_gives_up_its_lease() {
    use std::os::unix::process::CommandExt;
    let many = Many::new(&["s1".to_string()]);
    let path = stand_ins(&many);
    stand_in(&many, "sbatch", "echo 7");
    let site = format!("command = \"{}\"\ncpus = 1\n", env!("CARGO_BIN_EXE_use3d"));
    fs::write(many.at("cluster.toml"), site).expect("written");
    let long = ["--set", "reconstruct.iterations=20000", "--set", "reconstruct.checkpoint_steps=100000"];
    let words = [&["--cluster", "cluster.toml"][..], &long].concat();
    let (code, text) = submit(&many, &path, "slurm", "cache", &words);
    assert_eq!(code, Some(0), "{text}");
    let mut task = std::process::Command::new("bash");
    task.arg(many.at("use3d-out/many-submit/workers.sbatch")).env("SLURM_ARRAY_TASK_ID", "0");
    task.env("SLURM_JOB_ID", "7").env("PATH", &path).process_group(0);
    let mut task = task.stdout(std::process::Stdio::null()).spawn().expect("a shell");
    let log = many.at("cache/v1/logs/many/s1/_/reconstruct.log");
    // The lease shows the progress of its holder.
    let trains = || {
        tiny::files(&many.at("cache/v1/leases")).values().any(|lease| {
            String::from_utf8_lossy(lease)
                .lines()
                .any(|line| line.starts_with("here ") && line.contains("steps"))
        })
    };
    while !trains() {
        assert!(task.try_wait().expect("a state").is_none(), "ended before it was told to: {}", read(&log));
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    let group = format!("-{}", task.id());
    let told = std::process::Command::new("kill").args(["-TERM", "--", &group]).status();
    assert!(told.expect("kill").success());
    assert_eq!(task.wait().expect("ends").code(), Some(130));
    let saved = tiny::files(&many.at("cache/v1/checkpoints"));
    assert!(saved.keys().any(|path| path.starts_with("reconstruct")), "{:?}", saved.keys());
    // A lease that is given up says so, and no other process waits for it.
    for lease in tiny::files(&many.at("cache/v1/leases")).values() {
        let lease = String::from_utf8_lossy(lease);
        assert!(lease.lines().any(|line| line.starts_with("left ")), "{lease}");
    }
    // The next attempt goes on at that step, and not from the beginning.
    let mut again = many.command(&["run", "--cache-only"], "cache");
    let mut again = again.args(long).stdout(std::process::Stdio::null()).spawn().expect("the command starts");
    while !read(&log).contains("resuming from step") {
        assert!(again.try_wait().expect("a state").is_none(), "it did not resume: {}", read(&log));
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    again.kill().expect("killed");
    again.wait().expect("over");
}

#[test]
fn status_counts_and_chooses_and_a_run_that_only_gathers_names_what_is_missing() {
    let many = Many::new(&["s1".to_string(), "gone".to_string()]);
    fs::remove_dir_all(many.at("gone")).expect("removed");
    let asked = |verbs: &[&str], words: &[&str]| {
        let output = many.command(verbs, "cache").args(words).output().expect("the command starts");
        (output.status.code(), said(&output))
    };
    let (code, text) = asked(&["run"], &["--gather", "--keep-going", "--out", "out"]);
    assert!(code == Some(1) && text.contains("s1 · import") && !many.at("out/s1/scene").exists(), "{text}");
    assert!(many.artifacts("cache").is_empty(), "{text}");
    let (code, text) = asked(&["run"], &["--cache-only", "--keep-going"]);
    assert_eq!(code, Some(1), "{text}");
    let (code, text) = asked(&["run"], &["--gather", "--keep-going", "--out", "out"]);
    assert!(
        code == Some(1) && text.contains(" 0 stages done,") && many.at("out/s1/scores").exists(),
        "{text}"
    );
    let (code, text) = asked(&["status"], &["--summary"]);
    let import = text.lines().find(|line| line.starts_with("import")).unwrap_or_default();
    let counts: Vec<&str> = import.split_whitespace().collect();
    assert!(code == Some(0) && counts == ["import", "1", "-", "-", "-", "1"], "{text}");
    let (_, text) = asked(&["status"], &["--failed"]);
    assert!(text.contains("gone") && !text.contains("\ns1"), "{text}");
    let (_, text) = asked(&["status"], &["--scene", "s1"]);
    assert!(!text.contains("gone") && text.contains("\ns1"), "{text}");
    let (code, text) = asked(&["status"], &["--scene", "s2"]);
    assert!(code == Some(2) && text.contains("there are: s1, gone"), "{text}");
}

#[test]
fn a_killed_task_is_named_and_the_next_asks_for_more_memory() {
    let many = Many::new(&["s1".to_string()]);
    let path = stand_ins(&many);
    fs::write(many.at("cluster.toml"), "[stage.run]\nmemory = \"900MB\"\n").expect("written");
    let memory = || {
        let words = ["--cluster", "cluster.toml", "--dry-run"];
        let (code, text) = submit(&many, &path, "slurm", "cache", &words);
        assert_eq!(code, Some(0), "{text}");
        let line = text.lines().find(|line| line.starts_with("#SBATCH --mem=")).expect("a request");
        line.to_string()
    };
    assert_eq!(memory(), "#SBATCH --mem=859M");
    let run = |words: &[&str]| {
        let mut command = many.command(&["run", "--cache-only"], "cache");
        command.args(words).env("SLURM_JOB_ID", "12").env("SLURM_MEM_PER_NODE", "1000");
        command
    };
    let mut task = run(&["--set", "reconstruct.iterations=100000"]);
    let task = task.stdout(std::process::Stdio::null()).stderr(std::process::Stdio::null()).spawn();
    let mut task = task.expect("the command starts");
    let log = many.at("cache/v1/logs/many/s1/_/reconstruct.log");
    while !log.exists() {
        assert!(task.try_wait().expect("a state").is_none(), "ended before it was killed");
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    task.kill().expect("killed");
    task.wait().expect("over");
    let status = |words: &[&str]| {
        let output = many.command(&["status"], "cache").args(words).output().expect("the command starts");
        said(&output)
    };
    // The number of steps is a part of the key.
    let text = status(&["--set", "reconstruct.iterations=100000"]);
    let words = format!("killed: process {} on ", task.id());
    assert!(text.contains(&words) && text.contains("slurm 12 ended without a word"), "{text}");
    let words = ["--cluster", "cluster.toml", "--dry-run", "--set", "reconstruct.iterations=100000"];
    let (_, text) = submit(&many, &path, "slurm", "cache", &words);
    assert!(text.lines().any(|line| line == "#SBATCH --mem=1500M"), "{text}");
    assert_eq!(memory(), "#SBATCH --mem=859M");
}
