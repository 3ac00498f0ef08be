//! Runs a batch through a real Slurm with a controller and two nodes on this machine, with workers killed, a
//! node drained, the controller restarted, and a time limit; the bytes are those of a run of one process.
//! Another test cancels, preempts, requeues and kills a training, with nodes that cannot check each other's
//! processes. A third has a card in one partition only.
//!
//! It needs Slurm and munge, root, and some minutes, so it runs only on request:
//!
//! ```text
//! apt-get install --no-install-recommends slurm-wlm munge
//! USE3D_SLURM=1 USE3D_SCENES=use26 cargo test -p use3d --test slurm -- --nocapture
//! ```

mod machines;
mod many;
mod tiny;

use std::collections::BTreeSet;
use std::fs;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use machines::Fake;
use many::{Many, workers};

/// The longest time to wait for an empty queue.
const PATIENCE: Duration = Duration::from_secs(3600);

/// A controller and two nodes. All their processes end with this value.
struct Slurm {
    folder: PathBuf,
    running: Vec<(&'static str, Child)>,
    /// The machines of the nodes, if they are not this one.
    machines: Vec<Fake>,
}

/// The path of a program, including programs for administrators.
fn find(name: &str) -> Option<PathBuf> {
    let path = std::env::var("PATH").unwrap_or_default() + ":/usr/sbin:/sbin";
    path.split(':').map(|folder| PathBuf::from(folder).join(name)).find(|path| path.is_file())
}

fn port() -> u16 {
    let socket = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    socket.local_addr().expect("an address").port()
}

impl Slurm {
    /// Starts one. The nodes are this machine, unless there are other `machines` for them.
    fn start(folder: PathBuf, machines: Vec<Fake>) -> Self {
        for name in ["state", "spool/n1", "spool/n2", "log", "munge"] {
            fs::create_dir_all(folder.join(name)).expect("folder");
        }
        let here = folder.display();
        let host = fs::read_to_string("/proc/sys/kernel/hostname").expect("a name");
        let host = host.trim();
        let (control, first, second) = (port(), port(), port());
        let name = |n: usize| machines.get(n).map_or(host, |machine| machine.name.as_str());
        let (n1, n2) = (name(0), name(1));
        let text = format!(
            "ClusterName=onebox\nSlurmctldHost={host}(127.0.0.1)\nAuthType=auth/munge\nCryptoType=crypto/munge\n\
             AuthInfo=socket={here}/munge/socket\nCommunicationParameters=NoCtldInAddrAny,NoInAddrAny\nSlurmUser=root\n\
             SlurmdUser=root\nStateSaveLocation={here}/state\nSlurmdSpoolDir={here}/spool/%n\n\
             SlurmctldPidFile={here}/slurmctld.pid\nSlurmdPidFile={here}/slurmd-%n.pid\n\
             SlurmctldLogFile={here}/log/slurmctld.log\nSlurmdLogFile={here}/log/slurmd-%n.log\nSlurmctldPort={control}\n\
             ProctrackType=proctrack/linuxproc\nTaskPlugin=task/none\nJobAcctGatherType=jobacct_gather/none\n\
             AccountingStorageType=accounting_storage/none\nSwitchType=switch/none\nMpiDefault=none\nReturnToService=2\n\
             SchedulerType=sched/backfill\nSchedulerParameters=sched_interval=2,bf_interval=2\nSelectType=select/cons_tres\n\
             SelectTypeParameters=CR_Core\nOverTimeLimit=0\nKillWait=30\n\
             PreemptType=preempt/partition_prio\nPreemptMode=REQUEUE\n\
             NodeName=n1 NodeHostname={n1} NodeAddr=127.0.0.1 Port={first} CPUs=1 RealMemory=2000\n\
             NodeName=n2 NodeHostname={n2} NodeAddr=127.0.0.1 Port={second} CPUs=1 RealMemory=2000\n\
             PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP PriorityTier=1\n\
             PartitionName=card Nodes=n2 MaxTime=INFINITE State=UP PriorityTier=1\n\
             PartitionName=urgent Nodes=ALL MaxTime=INFINITE State=UP PriorityTier=2\n"
        );
        fs::write(folder.join("slurm.conf"), text).expect("written");
        fs::write(folder.join("munge/key"), [7u8; 128]).expect("written");
        let key = folder.join("munge/key");
        use std::os::unix::fs::PermissionsExt;
        fs::set_permissions(&key, fs::Permissions::from_mode(0o600)).expect("private");
        let mut slurm = Self { folder, running: Vec::new(), machines };
        let munge = slurm.folder.join("munge");
        let option = |name: &str, file: &str| format!("--{name}={}", munge.join(file).display());
        slurm.spawn(
            "munged",
            &[
                "--foreground",
                "--force",
                &option("socket", "socket"),
                &option("key-file", "key"),
                &option("pid-file", "pid"),
                &option("log-file", "log"),
                &option("seed-file", "seed"),
            ],
        );
        slurm.control();
        slurm.spawn_on(0, "slurmd", &["-D", "-N", "n1"]);
        slurm.spawn_on(1, "slurmd", &["-D", "-N", "n2"]);
        let start = Instant::now();
        // There is one line for each partition and state.
        let idle = |states: &str| !states.is_empty() && states.lines().all(|state| state.trim() == "idle");
        while !idle(&slurm.ask("sinfo", &["--noheader", "--format=%T"])) {
            assert!(start.elapsed() < Duration::from_secs(60), "no idle nodes: {}", slurm.logs());
            std::thread::sleep(Duration::from_millis(200));
        }
        slurm
    }

    fn control(&mut self) {
        self.spawn("slurmctld", &["-D"]);
    }

    fn spawn(&mut self, name: &'static str, arguments: &[&str]) {
        self.spawn_on(usize::MAX, name, arguments);
    }

    /// Starts a service on the machine of a node.
    fn spawn_on(&mut self, node: usize, name: &'static str, arguments: &[&str]) {
        let program = find(name).unwrap_or_else(|| panic!("{name} is not installed"));
        let mut command = self.with(Command::new(program));
        command.args(arguments);
        if let Some(machine) = self.machines.get(node) {
            command = machine.on(&command);
        }
        let child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn();
        self.running.push((name, child.unwrap_or_else(|e| panic!("{name}: {e}"))));
    }

    /// A command with the environment of this Slurm.
    fn with(&self, mut command: Command) -> Command {
        command.env("SLURM_CONF", self.folder.join("slurm.conf"));
        command
    }

    fn ask(&self, name: &str, arguments: &[&str]) -> String {
        let output = self.with(Command::new(name)).args(arguments).output().expect("the command starts");
        String::from_utf8_lossy(&output.stdout).into_owned()
    }

    /// Ends the processes of a name with a signal, like their service would.
    fn end(&mut self, name: &str) {
        for (_, mut child) in self.running.extract_if(.., |(n, _)| *n == name) {
            let told = Command::new("kill").arg(child.id().to_string()).status();
            assert!(told.expect("kill").success());
            child.wait().expect("ends");
        }
    }

    fn logs(&self) -> String {
        let logs = tiny::files(&self.folder.join("log"));
        logs.into_iter()
            .map(|(path, bytes)| format!("{}:\n{}", path.display(), String::from_utf8_lossy(&bytes)))
            .collect()
    }

    fn queue(&self) -> Vec<String> {
        self.ask("squeue", &["--noheader", "--format=%i %j %T %r"]).lines().map(String::from).collect()
    }
}

impl Drop for Slurm {
    fn drop(&mut self) {
        let _ = self.with(Command::new("scancel")).args(["--user", "root"]).status();
        std::thread::sleep(Duration::from_secs(1));
        for name in ["slurmd", "slurmctld", "munged"] {
            self.end(name);
        }
    }
}

/// The folder of a Slurm: munged requires that its user owns every folder above its socket.
fn place(name: &str) -> PathBuf {
    PathBuf::from(format!("/run/use3d-slurm-{}-{name}", std::process::id()))
}

/// The reason why the test cannot run here, if there is one.
fn refused() -> Option<String> {
    if std::env::var_os("USE3D_SLURM").is_none() {
        return Some("set USE3D_SLURM=1 to run it".to_string());
    }
    let missing = ["munged", "slurmctld", "slurmd", "sbatch"].into_iter().find(|name| find(name).is_none());
    missing.map(|name| {
        format!("{name} is not installed: apt-get install --no-install-recommends slurm-wlm munge")
    })
}

/// Submits the missing stages of a cache; returns the output.
fn submit(slurm: &Slurm, many: &Many, cache: &str, words: &[&str]) -> String {
    let mut command = slurm.with(many.command(&["submit", "slurm"], cache));
    command.args(["--cluster", "cluster.toml", "--out", &format!("out-{cache}")]).args(words);
    let output = command.output().expect("the command starts");
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
    text
}

#[test]
fn a_batch_through_a_real_slurm_ends_like_a_run_of_one_process() {
    if let Some(reason) = refused() {
        println!("SKIPPED, nothing was tested with a real Slurm: {reason}");
        return;
    }
    let many = Many::asked(4);
    let count = many.count;
    let start = Instant::now();
    let whole = many.alone();
    println!("{count} scenes by one process: {:.0} s", start.elapsed().as_secs_f64());
    let root = place("batch");
    let mut slurm = Slurm::start(root.clone(), Vec::new());
    let command = env!("CARGO_BIN_EXE_use3d");
    let mut site = format!("command = \"{command}\"\ncpus = 1\npartition = \"main\"\nat_once = 2\n");
    // Without these lines stages would request the memory of real scenes, which these nodes do not have.
    let table = use3d_pipeline::loaded::stages().expect("the table of stages");
    for stage in table.stages().iter().map(|stage| stage.name()).chain(["run"]) {
        site += &format!("[stage.{stage}]\nmemory = \"900MB\"\n");
    }
    fs::write(many.at("cluster.toml"), site).expect("written");
    for layout in ["workers", "stages"] {
        let start = Instant::now();
        let (mut rounds, mut signals, mut kills) = (0, 0, 0);
        let (mut drained, mut restarted) = (false, false);
        // Repeated until there is nothing to submit: the same command repairs killed work.
        loop {
            rounds += 1;
            let text = submit(&slurm, &many, layout, &["--layout", layout]);
            if text.contains("nothing to submit") {
                break;
            }
            assert!(rounds < 20, "{text}");
            let mut looks = 0;
            while !slurm.queue().is_empty() {
                looks += 1;
                assert!(start.elapsed() < PATIENCE, "{:?}{}", slurm.queue(), slurm.logs());
                std::thread::sleep(Duration::from_millis(500));
                if rounds == 1 {
                    let workers = workers(&many.at(layout).to_string_lossy());
                    let one = workers.get(looks % workers.len().max(1));
                    if let Some(pid) = one.filter(|_| looks % 8 == 0 && kills < 3) {
                        kills += usize::from(
                            Command::new("kill")
                                .args(["-9", &pid.to_string()])
                                .status()
                                .expect("kill")
                                .success(),
                        );
                    }
                    // Slurm sends this signal shortly before a time limit: the job writes a checkpoint and
                    // enters the queue again.
                    let running = || slurm.queue().into_iter().find(|line| line.contains(" RUNNING "));
                    if looks >= 4
                        && signals == 0
                        && let Some(job) = running()
                    {
                        let id = job.split(' ').next().unwrap_or_default().to_string();
                        slurm.ask("scancel", &["--batch", "--signal=USR1", &id]);
                        signals += 1;
                    }
                    if looks == 10 {
                        slurm.ask("scontrol", &["update", "nodename=n2", "state=drain", "reason=test"]);
                    } else if (11..24).contains(&looks) && !drained {
                        let state = slurm.ask("sinfo", &["--noheader", "--nodes=n2", "--format=%T"]);
                        drained = state.starts_with("drain");
                    } else if looks == 24 {
                        slurm.ask("scontrol", &["update", "nodename=n2", "state=resume"]);
                    }
                }
                if looks == 16 && !restarted {
                    slurm.end("slurmctld");
                    slurm.control();
                    restarted = true;
                }
            }
        }
        let happened = [kills > 0, signals > 0, drained, restarted];
        assert_eq!(
            happened, [true; 4],
            "{layout}: killed, signalled, drained, restarted: what is not true was not tested"
        );
        let apart = Many::apart(&many.artifacts(layout), &whole);
        assert!(apart.is_empty(), "{layout}: the artifacts are not those of one process: {apart:?}");
        assert_eq!(many.scores(format!("out-{layout}").as_ref()).len(), count);
        println!(
            "{layout}: {rounds} submissions, {:.0} s, {kills} workers killed, {signals} told that its time is over",
            start.elapsed().as_secs_f64()
        );
    }
    drop(slurm);
    fs::remove_dir_all(root).expect("removed");
}

/// One partition has a card, a software one; the login node and the other partition see none. Trainings run
/// on the card, everything else without, and no stage is computed twice.
#[test]
fn trainings_run_in_the_partition_with_the_card_and_everything_else_without() {
    if let Some(reason) = refused() {
        println!("SKIPPED, nothing was tested with a real Slurm: {reason}");
        return;
    }
    let Ok(drivers) = std::env::var("VK_DRIVER_FILES") else {
        println!("SKIPPED, nothing was tested with a card: set VK_DRIVER_FILES to the driver of lavapipe");
        return;
    };
    let many = Many::asked(4);
    let root = place("card");
    let slurm = Slurm::start(root.clone(), Vec::new());
    let none = many.at("none.json");
    let site = format!(
        r#"command = "{}"
cpus = 1
partition = "main"
memory = "900MB"
setup = ["export VK_DRIVER_FILES={}", '[ "$SLURM_JOB_PARTITION" != card ] || export VK_DRIVER_FILES={drivers}']
[stage.reconstruct]
partition = "card"
memory = "900MB"
"#,
        env!("CARGO_BIN_EXE_use3d"),
        none.display()
    );
    fs::write(many.at("cluster.toml"), site).expect("written");
    let sets = ["--set", "reconstruct.engine=gpu:llvmpipe"];
    let start = Instant::now();
    let mut rounds = 0;
    loop {
        rounds += 1;
        let mut command = slurm.with(many.command(&["submit", "slurm"], "cache"));
        command.env("VK_DRIVER_FILES", &none).args(sets);
        command.args(["--cluster", "cluster.toml", "--layout", "stages", "--out", "out"]);
        let output = command.output().expect("the command starts");
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
        if text.contains("nothing to submit") {
            break;
        }
        assert!(rounds < 3, "{text}{:?}", tiny::files(&many.at("out-submit/logs")));
        while !slurm.queue().is_empty() {
            assert!(start.elapsed() < PATIENCE, "{:?}{}", slurm.queue(), slurm.logs());
            std::thread::sleep(Duration::from_millis(500));
        }
    }
    let (mut trained, mut elsewhere) = (0, 0);
    for (path, bytes) in tiny::files(&many.at("out-submit")) {
        let text = String::from_utf8_lossy(&bytes).into_owned();
        let cards = text.lines().filter(|line| line.contains("engine: gpu, llvmpipe")).count();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        match name.starts_with("reconstruct-") && name.ends_with(".log") {
            true => trained += cards,
            false => elsewhere += cards,
        }
    }
    assert_eq!((trained, elsewhere), (many.count, 0), "{:#?}", tiny::files(&many.at("out-submit/logs")));
    // Each line of the journal is one computation.
    let journals = tiny::files(&many.at("cache/v1/timings")).into_values();
    let journal: String = journals.map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).collect();
    let computed: Vec<(String, String)> = journal
        .lines()
        .map(|line| serde_json::from_str::<serde_json::Value>(line).expect("JSON"))
        .map(|line| (line["stage"].to_string(), line["scene"].to_string()))
        .collect();
    let distinct: BTreeSet<_> = computed.iter().collect();
    assert_eq!(computed.len(), distinct.len(), "a stage was computed twice: {computed:?}");
    assert_eq!(many.scores("out".as_ref()).len(), many.count);
    println!(
        "{} scenes with a card in one partition: {rounds} submissions, {:.0} s, {} stages computed, none twice",
        many.count,
        start.elapsed().as_secs_f64(),
        computed.len()
    );
    drop(slurm);
    fs::remove_dir_all(root).expect("removed");
}

/// The test sends no signal: the controller does, because the job's time is nearly over. The training writes
/// a checkpoint, the script enters the queue again, and the next attempt resumes from there.
#[test]
fn what_is_longer_than_its_jobs_limit_goes_on_in_the_next() {
    if let Some(reason) = refused() {
        println!("SKIPPED, nothing was tested with a real Slurm: {reason}");
        return;
    }
    let many = Many::new(&["reef".to_string()]);
    let alone = |cache: &str, steps: &[String]| {
        let start = Instant::now();
        let mut command = many.command(&["-q", "run"], cache);
        let output = command
            .args(steps)
            .args(["--threads", "1", "--cache-only"])
            .output()
            .expect("the command starts");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        start.elapsed()
    };
    let sets = |steps: u64| {
        let sets = [format!("reconstruct.iterations={steps}"), "reconstruct.checkpoint_steps=20".to_string()];
        sets.into_iter().flat_map(|set| ["--set".to_string(), set]).collect::<Vec<_>>()
    };
    // Enough steps for about the time limit of a job on this machine.
    let (short, until) = (500, ["--until".to_string(), "reconstruct".to_string()]);
    let speed = short as f64 / alone("short", &[&sets(short)[..], &until].concat()).as_secs_f64();
    let steps = sets((speed * 100.0) as u64);
    let whole = alone("alone", &steps);
    println!("by one process: {} in {:.0} s", steps[1], whole.as_secs_f64());
    let root = place("limit");
    let slurm = Slurm::start(root.clone(), Vec::new());
    // A later option of a script wins: two minutes, of which the last is for saving. Slurm may send the
    // signal half a minute earlier.
    let site = format!(
        "command = \"{}\"\ncpus = 1\npartition = \"main\"\noptions = [\"--time=2\", \"--signal=B:USR1@75\"]\n\
         [stage.run]\nmemory = \"900MB\"\n",
        env!("CARGO_BIN_EXE_use3d")
    );
    fs::write(many.at("cluster.toml"), site).expect("written");
    let words: Vec<&str> = steps.iter().map(String::as_str).collect();
    let start = Instant::now();
    submit(&slurm, &many, "limit", &words);
    while !slurm.queue().is_empty() {
        assert!(start.elapsed() < PATIENCE, "{:?}{}", slurm.queue(), slurm.logs());
        std::thread::sleep(Duration::from_secs(1));
    }
    let logs: Vec<String> = tiny::files(&many.at("out-limit-submit/logs"))
        .into_values()
        .map(|bytes| String::from_utf8_lossy(&bytes).into_owned())
        .collect();
    let attempts = logs.iter().flat_map(|log| log.lines()).filter(|line| line.contains(", attempt ")).count();
    let told = logs
        .iter()
        .flat_map(|log| log.lines())
        .filter(|line| line.starts_with("time limit reached;"))
        .count();
    assert!(told > 0 && attempts == logs.len() + told, "{attempts} attempts, {told} out of time: {logs:#?}");
    assert!(submit(&slurm, &many, "limit", &words).contains("nothing to submit"), "{logs:#?}");
    assert!(many.artifacts("limit") == many.artifacts("alone"), "the artifacts are not those of one process");
    println!(
        "in jobs of two minutes: {:.0} s, {attempts} attempts of {} tasks",
        start.elapsed().as_secs_f64(),
        logs.len()
    );
    drop(slurm);
    fs::remove_dir_all(root).expect("removed");
}

/// The state of a training that the scheduler interrupts.
struct Training<'m> {
    many: &'m Many,
    slurm: &'m Slurm,
}

impl Training<'_> {
    /// The steps of its checkpoints.
    fn saved(&self) -> BTreeSet<u64> {
        let files = tiny::files(&self.many.at("cache/v1/checkpoints/reconstruct"));
        let step = |path: PathBuf| path.file_stem()?.to_str()?.rsplit('-').next()?.parse().ok();
        files.into_keys().filter_map(step).collect()
    }

    /// The logs of its tasks, sorted by path. A submission beside a waiting one has a folder of its own.
    fn logs(&self) -> Vec<(PathBuf, String)> {
        let files = tiny::files(&self.many.at("use3d-out/many-submit")).into_iter();
        let logs = files.filter(|(path, _)| path.extension().is_some_and(|end| end == "log"));
        let text = |bytes: Vec<u8>| String::from_utf8_lossy(&bytes).into_owned();
        let mut logs: Vec<_> = logs.map(|(path, bytes)| (path, text(bytes))).collect();
        logs.sort();
        logs
    }

    /// The steps from which the training resumed, in order.
    fn resumed(&self) -> Vec<u64> {
        let text: String = self.logs().into_iter().map(|(_, text)| text).collect();
        let steps = text.split("resuming from step ").skip(1);
        steps.filter_map(|rest| rest.split(' ').next()?.parse().ok()).collect()
    }

    /// The node that trains, and its progress by its lease.
    fn trains(&self) -> Option<(String, u64)> {
        let leases = tiny::files(&self.many.at("cache/v1/leases"));
        leases.iter().filter(|(path, _)| !path.to_string_lossy().starts_with("run-")).find_map(
            |(_, bytes)| {
                let text = String::from_utf8_lossy(bytes).into_owned();
                let (holder, pulse) = text.split_once('\n')?;
                let holder: serde_json::Value = serde_json::from_str(holder).ok()?;
                let words: Vec<&str> = pulse.split_whitespace().collect();
                (words.first() == Some(&"here")).then_some(())?;
                Some((holder["host"].as_str()?.to_string(), words.get(3)?.parse().ok()?))
            },
        )
    }

    fn wait_for<T>(&self, what: &str, most: u64, found: impl Fn() -> Option<T>) -> (T, Duration) {
        let start = Instant::now();
        loop {
            if let Some(found) = found() {
                return (found, start.elapsed());
            }
            let queue = self.slurm.queue();
            let late = start.elapsed() >= Duration::from_secs(most);
            assert!(!late, "no {what} after {most} s: {queue:?}{:#?}", self.logs());
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// Waits until the training has done more steps than are saved.
    fn wait_for_progress(&self) -> (String, u64) {
        let saved = self.saved().last().copied().unwrap_or(0);
        self.wait_for("progress", 400, || self.trains().filter(|(_, step)| *step > saved)).0
    }

    /// Waits until a checkpoint is written after an interruption at about `step`; returns its step.
    fn wait_for_checkpoint(&self, what: &str, step: u64) -> u64 {
        let saved = || self.saved().last().copied().filter(|saved| *saved >= step);
        let (saved, waited) = self.wait_for("checkpoint", 30, saved);
        println!("{what}: at step {step} or later, saved at {saved} after {:.1} s", waited.as_secs_f64());
        saved
    }
}

/// Slurm signals every process of a task that is cancelled, preempted or requeued. The training writes a
/// checkpoint of its last step each time, and goes on from there. When all processes of a task are killed,
/// its training goes on at another node within half a minute.
#[test]
fn what_slurm_interrupts_loses_no_step_and_what_is_killed_goes_on_soon() {
    if let Some(reason) = refused() {
        println!("SKIPPED, nothing was tested with a real Slurm: {reason}");
        return;
    }
    let machines = ["n1", "n2"].map(|name| Fake::start(name).unwrap_or_else(|e| panic!("{e}")));
    let many = Many::new(&["reef".to_string()]);
    let root = place("signals");
    let slurm = Slurm::start(root.clone(), machines.into());
    let site = format!(
        "command = \"{}\"\ncpus = 1\npartition = \"main\"\n[stage.run]\nmemory = \"900MB\"\n",
        env!("CARGO_BIN_EXE_use3d")
    );
    fs::write(many.at("cluster.toml"), site).expect("written");
    // No checkpoint is written but those for signals.
    let long = ["reconstruct.iterations=2000000", "reconstruct.checkpoint_steps=2000000"];
    let words: Vec<String> = long.iter().flat_map(|set| ["--set".to_string(), set.to_string()]).collect();
    let submit = |more: &[&str]| {
        let mut command = slurm.with(many.command(&["submit", "slurm", "-q"], "cache"));
        command.args(["--cluster", "cluster.toml"]).args(&words).args(more);
        let output = command.output().expect("the command starts");
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
        let number = text.split("submitted workers as job ").nth(1).and_then(|rest| rest.lines().next());
        number.expect("a number").to_string()
    };
    let training = Training { many: &many, slurm: &slurm };
    let empty = || slurm.queue().is_empty().then_some(());

    submit(&[]);
    let (_, step) = training.wait_for_progress();
    let mut cancel = slurm.with(tiny::command());
    cancel.arg("cancel").arg(many.at("many.toml")).current_dir(many.at(""));
    let output = cancel.output().expect("the command starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let cancelled = training.wait_for_checkpoint("cancelled", step);
    training.wait_for("empty queue", 60, empty);
    assert_eq!(training.trains(), None, "no lease is left of a cancelled task");

    let first = submit(&[]);
    training.wait_for_progress();
    assert_eq!(training.resumed(), [cancelled]);
    // A job that is more urgent wants both nodes.
    let (_, step) = training.wait_for_progress();
    let urgent = ["--partition=urgent", "--nodes=2", "--mem=100M", "--output=/dev/null", "--wrap=sleep 2"];
    slurm.ask("sbatch", &urgent);
    let preempted = training.wait_for_checkpoint("preempted", step);
    training.wait_for_progress();
    assert_eq!(training.resumed(), [cancelled, preempted]);
    let (_, step) = training.wait_for_progress();
    slurm.ask("scontrol", &["requeue", &format!("{first}_0")]);
    let requeued = training.wait_for_checkpoint("requeued", step);
    let (node, _) = training.wait_for_progress();
    assert_eq!(training.resumed(), [cancelled, preempted, requeued]);

    // A second task waits on the other node.
    let second = submit(&["--again"]);
    let waits = || {
        let name = format!("workers-{second}_0.log");
        let logs = training.logs();
        let log = logs.iter().find(|(path, _)| path.ends_with(&name));
        log.is_some_and(|(_, text)| text.contains("is at this step (process")).then_some(())
    };
    training.wait_for("second task", 60, waits);
    let (pids, own) = (workers("cache"), |pid: u32| {
        let name = fs::read_to_string(format!("/proc/{pid}/environ")).unwrap_or_default();
        name.split('\0').any(|variable| variable == format!("SLURMD_NODENAME={node}"))
    });
    let victim = pids.into_iter().find(|pid| own(*pid)).expect("the training process");
    let group = Command::new("ps").args(["-o", "pgid=", "-p", &victim.to_string()]).output().expect("ps");
    let group = String::from_utf8_lossy(&group.stdout).trim().to_string();
    let killed = Command::new("kill").args(["-9", "--", &format!("-{group}")]).status();
    assert!(killed.expect("kill").success());
    let other = || training.trains().filter(|(on, _)| *on != node);
    let ((next, _), waited) = training.wait_for("other node", 30, other);
    println!("killed on {node}: {next} goes on after {:.1} s", waited.as_secs_f64());
    training.wait_for_progress();
    assert_eq!(training.resumed().last(), Some(&requeued));
    drop(slurm);
    fs::remove_dir_all(root).expect("removed");
}
