//! A week of dives in small: films and captures arrive while two machines work, each with a cache of its own,
//! and share one store. One dive in fifty is broken, and one machine is lost with its cache. In the end one
//! page has every dive, the broken ones are named, and nothing was computed twice except what the lost
//! machine had in hand.
//!
//! The usual run has a few captures. A thousand dives, 20 of them films, on machines that cannot see each
//! other's processes (as root on Linux):
//!
//! ```text
//! USE3D_SCENES=1000 USE3D_MACHINES=2 cargo test --workspace --test week -- --nocapture
//! ```
//!
//! With `USE3D_MOTO` the store is a bucket of a real S3 server, as in the test `bucket`.

mod machines;
#[cfg(feature = "s3")]
mod moto;
mod tiny;

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use machines::Fake;
use tiny::{TINY, files};
use use3d_io_colmap::{read_model, write_model_binary};

/// One dive in this many is a film, and another one is broken.
const OFTEN: usize = 50;
/// The days on which dives arrive.
const DAYS: usize = 7;

/// The place of the week: the dives that have not arrived yet, those that have, and the store.
struct Week {
    dir: tempfile::TempDir,
    store: String,
    /// Variables with which the store is reached.
    variables: Vec<(&'static str, String)>,
    names: Vec<String>,
    broken: BTreeSet<String>,
    arrived: usize,
}

impl Week {
    fn new(count: usize, films: bool) -> Self {
        let dir = tempfile::tempdir().expect("a folder");
        let store = dir.path().join("store").display().to_string();
        let mut week = Self {
            dir,
            store,
            variables: Vec::new(),
            names: (0..count).map(|k| format!("d{k:04}")).collect(),
            broken: BTreeSet::new(),
            arrived: 0,
        };
        for folder in ["store", "dives", "waiting"] {
            fs::create_dir(week.at(folder)).expect("a folder");
        }
        let reef = week.at("reef");
        tiny::synthesise(&reef, &["capture", "--views", "3", "--size", "32x24", "--no-depth-priors"]);
        // A few points are enough, and make small artifacts.
        let model = reef.join("sparse/0");
        let mut few = read_model(&model).expect("a model");
        few.points = few.points.into_iter().step_by(25).collect();
        few.points.iter_mut().for_each(|point| point.track.clear());
        few.images.iter_mut().for_each(|image| image.keypoints.clear());
        write_model_binary(&model, &few).expect("written");
        if films {
            week.film();
        }
        for (k, name) in week.names.clone().iter().enumerate() {
            match k % OFTEN.min(count) {
                1 if films => week.copy_film(name),
                place => {
                    let broken = place == OFTEN.min(count) / 2;
                    if broken {
                        week.broken.insert(name.clone());
                    }
                    week.copy_capture(name, k, broken);
                }
            }
        }
        let file = "name = \"week\"\nseed = 42\n[[scene]]\nfrom = \"dives/*\"\n";
        fs::write(week.at("week.toml"), file).expect("written");
        week
    }

    fn at(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    /// Makes a film of a swim.
    fn film(&self) {
        let views = self.at("views");
        tiny::synthesise(&views, &["capture", "--views", "24", "--size", "320x180", "--no-depth-priors"]);
        let mut names: Vec<PathBuf> = files(&views.join("images")).into_keys().collect();
        names.sort();
        for (k, name) in names.iter().enumerate() {
            fs::rename(views.join("images").join(name), views.join(format!("{k:03}.png"))).expect("renamed");
        }
        let mut ffmpeg = Command::new("ffmpeg");
        ffmpeg.args(["-loglevel", "error", "-framerate", "5", "-i"]).arg(views.join("%03d.png"));
        let made = ffmpeg.args(["-crf", "12", "-pix_fmt", "yuv420p"]).arg(self.at("swim.mp4")).status();
        assert!(made.expect("ffmpeg starts").success());
    }

    /// A film with a comment of its own, so that it is another input.
    fn copy_film(&self, name: &str) {
        let to = self.at("waiting").join(name).with_extension("mp4");
        let mut ffmpeg = Command::new("ffmpeg");
        ffmpeg.args(["-loglevel", "error", "-i"]).arg(self.at("swim.mp4"));
        let made = ffmpeg.args(["-c", "copy", "-metadata", &format!("comment={name}")]).arg(to).status();
        assert!(made.expect("ffmpeg starts").success());
    }

    /// A capture in which one point has a colour of its own.
    fn copy_capture(&self, name: &str, number: usize, broken: bool) {
        let (from, to) = (self.at("reef"), self.at("waiting").join(name));
        for path in files(&from).into_keys() {
            let (from, to) = (from.join(&path), to.join(&path));
            fs::create_dir_all(to.parent().expect("a folder")).expect("a folder");
            if path.ends_with("points3D.bin") {
                let mut bytes = fs::read(from).expect("read");
                // The number of points, and the number and place of the first one are before its colour.
                bytes[40..42].copy_from_slice(&(number as u16).to_le_bytes());
                fs::write(to, bytes).expect("written");
            } else if broken && path.ends_with("images.bin") {
                fs::write(to, b"no model").expect("written");
            } else {
                fs::hard_link(from, to).expect("linked");
            }
        }
    }

    /// The dives of the next day arrive.
    fn next_day(&mut self) {
        let until = (self.arrived + self.names.len().div_ceil(DAYS)).min(self.names.len());
        for name in &self.names[self.arrived..until] {
            let film = format!("{name}.mp4");
            let name = if self.at("waiting").join(&film).exists() { &film } else { name };
            fs::rename(self.at("waiting").join(name), self.at("dives").join(name)).expect("moved");
        }
        self.arrived = until;
    }

    /// The number of arrived dives that can be finished.
    fn sound(&self) -> usize {
        self.names[..self.arrived].iter().filter(|name| !self.broken.contains(*name)).count()
    }

    fn run(&self, cache: &Path) -> Command {
        let mut command = tiny::command();
        command.args(["-q", "run"]).arg(self.at("week.toml")).arg("--cache").arg(cache);
        command.args(["--remote", &self.store, "--keep-going", "--threads", "1", "--json"]);
        let quick =
            ["reconstruct.iterations=4", "enhance.iterations=2", "calibrate.steps=5", "import.max_side=32"];
        let films = ["prepare.frames=24", "prepare.features=800"];
        for set in TINY.iter().chain(&quick).chain(&films) {
            command.args(["--set", set]);
        }
        command.envs(self.variables.iter().map(|(name, value)| (*name, value)));
        command
    }
}

/// A machine that runs the pipeline again and again with a cache of its own.
struct Machine {
    name: &'static str,
    fake: Option<Fake>,
    cache: PathBuf,
    child: Child,
    /// The number of its runs, and the dives that had arrived when the last one began.
    runs: usize,
    arrived: usize,
    /// The number of stages that its finished runs computed.
    computed: usize,
    at_rest: bool,
}

impl Machine {
    fn start(week: &Week, name: &'static str, apart: bool) -> Self {
        let fake = apart.then(|| Fake::start(name).unwrap_or_else(|e| panic!("{e}")));
        let cache = week.at(name);
        let child = Self::spawn(week, fake.as_ref(), &cache, &week.at(&format!("{name}-0")));
        Self { name, fake, cache, child, runs: 0, arrived: week.arrived, computed: 0, at_rest: false }
    }

    fn spawn(week: &Week, fake: Option<&Fake>, cache: &Path, said: &Path) -> Child {
        let mut command = week.run(cache);
        command.arg("--cache-only");
        if let Some(fake) = fake {
            command = fake.on(&command);
        }
        let to = |kind: &str| File::create(said.with_extension(kind)).expect("a file");
        command.stdout(to("json")).stderr(to("txt")).stdin(Stdio::null());
        // A group of its own, to be killed as a whole.
        command.process_group(0).spawn().expect("the command starts")
    }

    fn said(&self, week: &Week) -> PathBuf {
        week.at(&format!("{}-{}", self.name, self.runs))
    }

    /// Notices the end of a run, and begins the next one if dives arrived meanwhile.
    fn look(&mut self, week: &Week) {
        if self.at_rest {
            self.at_rest = self.arrived == week.arrived;
        } else if let Some(status) = self.child.try_wait().expect("a state") {
            let read =
                |kind: &str| fs::read_to_string(self.said(week).with_extension(kind)).expect("what it said");
            assert!(matches!(status.code(), Some(0 | 1)), "{}: {status}: {}", self.name, read("txt"));
            let summary: serde_json::Value = serde_json::from_str(&read("json")).expect("JSON");
            let nodes = summary["nodes"].as_array().expect("nodes").iter();
            self.computed += nodes.filter(|node| node["result"] == "done").count();
            self.at_rest = self.arrived == week.arrived;
        } else {
            return;
        }
        if !self.at_rest {
            self.runs += 1;
            self.arrived = week.arrived;
            self.child = Self::spawn(week, self.fake.as_ref(), &self.cache, &self.said(week));
        }
    }

    /// The scenes whose last stage is in the cache.
    fn done(&self) -> BTreeSet<String> {
        let folder = fs::read_dir(self.cache.join("v1/artifacts/evaluate")).into_iter().flatten().flatten();
        folder.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect()
    }

    /// The manifests of the artifacts in the cache. They have the time of the computation, so two that are
    /// equal are of one.
    fn manifests(&self) -> BTreeMap<String, Vec<u8>> {
        let root = self.cache.join("v1/artifacts");
        let mut found = BTreeMap::new();
        for stage in fs::read_dir(&root).expect("stages").flatten() {
            for key in fs::read_dir(stage.path()).expect("keys").flatten() {
                let names = [stage.file_name(), key.file_name()].map(|n| n.to_string_lossy().into_owned());
                let bytes = fs::read(key.path().join("manifest.json")).expect("a manifest");
                found.insert(names.join("/"), bytes);
            }
        }
        found
    }
}

/// Runs a program to see if it is there.
fn runs(program: &str, argument: &str) -> bool {
    let mut command = Command::new(program);
    command.arg(argument).env("QT_QPA_PLATFORM", "offscreen").stdout(Stdio::null()).stderr(Stdio::null());
    command.status().is_ok_and(|status| status.success())
}

#[test]
fn a_week_of_dives_on_two_machines_with_one_store_ends_well_though_one_is_lost() {
    let asked = std::env::var("USE3D_SCENES").ok().map(|n| n.parse().expect("a number of scenes"));
    let count = asked.unwrap_or(8);
    let apart = std::env::var_os("USE3D_MACHINES").is_some();
    let films = asked.is_some() && runs("colmap", "help") && runs("ffmpeg", "-version");
    if !films {
        println!("no film was among the dives: set USE3D_SCENES, and install colmap and ffmpeg");
    }
    let mut week = Week::new(count, films);
    #[cfg(feature = "s3")]
    let moto = moto::Moto::asked();
    #[cfg(feature = "s3")]
    if let Some(moto) = &moto {
        (week.store, week.variables) = (moto.bucket("week"), moto.variables());
    }
    let started = Instant::now();
    week.next_day();
    let [mut stays, mut lost] = ["n1", "n2"].map(|name| Machine::start(&week, name, apart));
    let mut next: Option<Machine> = None;
    let (mut stages_of_lost, mut kept) = (0, BTreeMap::new());
    loop {
        std::thread::sleep(Duration::from_millis(if count > 100 { 500 } else { 20 }));
        let other = next.as_ref().unwrap_or(&lost);
        let done = stays.done().union(&other.done()).count();
        // A machine is lost in the middle of a run, with everything that only it had.
        let is_busy = lost.child.try_wait().expect("a state").is_none();
        if next.is_none() && done * 2 >= count && (is_busy || week.arrived == count) {
            let group = format!("-{}", lost.child.id());
            let killed = Command::new("kill").args(["-9", "--", &group]).status();
            assert!(!is_busy || killed.expect("kill starts").success());
            lost.child.wait().expect("gone");
            stages_of_lost = lost.computed;
            kept = lost.manifests();
            fs::remove_dir_all(&lost.cache).expect("removed");
            println!(
                "{:.0} s: a machine is lost {}, {done} dives are done",
                started.elapsed().as_secs_f64(),
                if is_busy { "at work" } else { "at rest" }
            );
            next = Some(Machine::start(&week, "n3", apart));
            continue;
        }
        // Dives arrive while the machines are at work.
        if week.arrived < count && done * 5 >= week.sound() * 3 {
            week.next_day();
            println!(
                "{:.0} s: {} of {count} dives have arrived",
                started.elapsed().as_secs_f64(),
                week.arrived
            );
        }
        let second = next.as_mut().unwrap_or(&mut lost);
        stays.look(&week);
        second.look(&week);
        if week.arrived == count && stays.at_rest && second.at_rest && next.is_some() {
            break;
        }
    }
    let next = next.expect("a new machine");

    // One page has all of them.
    let output = week.run(&stays.cache).arg("--report-only").arg("--out").arg(week.at("out")).output();
    assert_eq!(output.expect("the command starts").status.code(), Some(1), "some are broken");
    let page = fs::read_to_string(week.at("out/report.html")).expect("the overview");
    let rows = |class: &str| {
        let row = format!("<tr class=\"{class}\"");
        page.lines().filter(|line| line.contains(&row)).map(String::from).collect::<Vec<_>>()
    };
    let done: usize = ["good", "bad", "plain"].iter().map(|class| rows(class).len()).sum();
    let failed = rows("failed");
    assert_eq!((done, failed.len()), (count - week.broken.len(), week.broken.len()));
    assert_eq!(rows("incomplete").len(), 0);
    for name in &week.broken {
        let of = |row: &&String| row.contains(&format!(">{name}</a>")) && row.contains("images.bin");
        assert_eq!(failed.iter().filter(of).count(), 1, "{name}: {failed:?}");
    }
    assert!(page.contains(&format!("{} scene", week.broken.len())), "they are named above");

    // The manifests of both caches are those of one computation.
    let (ours, theirs) = (stays.manifests(), next.manifests());
    let differ = |a: &BTreeMap<String, Vec<u8>>, b: &BTreeMap<String, Vec<u8>>| {
        a.iter().filter(|(key, bytes)| b.get(*key).is_some_and(|other| other != *bytes)).count()
    };
    let twice = differ(&ours, &theirs);
    // The machine that was lost had results in hand that it had not sent yet.
    let held = differ(&kept, &ours);
    println!(
        "{count} dives ({} films): {done} done, {} named; {} artifacts, {} and {} computed by two machines and \
         {stages_of_lost} in the finished runs of the lost one; computed twice: {twice}, and {held} that the lost \
         machine had and not sent; {:.0} s",
        if films { count.div_ceil(OFTEN) } else { 0 },
        failed.len(),
        ours.len(),
        stays.computed,
        next.computed,
        started.elapsed().as_secs_f64()
    );
    assert_eq!(twice, 0);
    assert!(held <= 1, "a machine sends what it has computed before it computes anything else: {held}");
}
