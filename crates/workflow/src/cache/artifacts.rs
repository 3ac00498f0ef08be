//! The cache on disk.
//!
//! ```text
//! <folder>/CACHEDIR.TAG                                  makes backup programs skip the folder
//! <folder>/v1/artifacts/<stage>/<key>/…, manifest.json   complete or absent
//! <folder>/v1/checkpoints/<stage>/<key without length>/  from which long stages resume
//! <folder>/v1/history/<pipeline>/<scene>/<variant>/<stage>.json   the last record of a node
//! <folder>/v1/logs/…  timings/<machine>.jsonl            logs, durations for forecasts
//! <folder>/v1/stat-table                                 stored digests of input files
//! <folder>/v1/leases/<key>  run-…                        leases of keys and of runs
//! <folder>/v1/fetched/<key>                              marks an artifact that came from a store
//! <folder>/v1/killed/<key>.json                          notes about processes that were killed
//! <folder>/v1/devices/<name>.json                        classes of the cards that have computed
//! <folder>/v1/delivered/<results folder>/<part>.json     the sources of the files in a results folder
//! <folder>/v1/tmp/  damaged/                             unfinished folders; damaged artifacts
//! ```
//!
//! An artifact is made in `tmp`, its files synced, its manifest written last, and the folder renamed into
//! place, so a crash at any moment leaves either no artifact or a whole one. Several processes, also of
//! several machines, may share a cache: the first to publish a key wins, and another one's different bytes
//! raise an alarm. There is no lock to remove by hand, and no lock of the file system is used.

use std::collections::{BTreeMap, BTreeSet};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::{Duration, SystemTime};

use rayon::prelude::*;

use crate::cache::content::{Content, Contents};
use crate::cache::device::Answers;
use crate::cache::files::{self, Disk, Files};
use crate::cache::key::{Ingredients, Key};
use crate::cache::lock;
use crate::cache::manifest::{self, Circumstances, FileRecord, MANIFEST, Manifest};
use crate::cache::node::Node;
use crate::cache::task::IsOver;
use crate::cache::watch::Watch;
use crate::error::FileError;
use use3d_code::digest::Digest;
use use3d_files::folder_of;

/// The longest time for which a network file system may hide a name that exists: clients cache for a minute
/// that a name did not exist.
const LATE: Duration = Duration::from_secs(90);

/// The folder of this version in the cache folder.
const ROOT: &str = "v1";

const TAG: &str = "Signature: 8a477f597d28d172789f06886806bc55\n\
    # This folder holds results of use3d that can be computed again.\n";

/// A cache folder.
#[derive(Clone)]
pub struct Cache {
    root: PathBuf,
    files: Arc<dyn Files>,
    /// Digests of inputs.
    pub(crate) contents: Arc<Contents>,
    verified: Arc<Mutex<BTreeSet<Key>>>,
    /// The observations of leases by this process.
    pub(crate) leases: Arc<Watch>,
    /// The identity and clock with which this process uses the cache.
    pub(crate) node: Arc<Node>,
    /// The files that stages promise, by stage.
    promises: Arc<BTreeMap<&'static str, &'static [&'static str]>>,
    pub(crate) devices: Arc<Mutex<Answers>>,
}

/// An artifact that exists in the cache.
#[derive(Clone, Debug)]
pub struct Artifact {
    /// Its folder, which is read only by convention.
    pub path: PathBuf,
    /// Its manifest.
    pub manifest: Manifest,
}

/// Result of looking up a key.
#[derive(Clone, Debug)]
pub enum Lookup {
    /// There is nothing.
    Missing,
    /// The complete artifact.
    Whole(Arc<Artifact>),
    /// An artifact that differs from its manifest, with the reason.
    Damaged(String),
}

/// Result of publishing a folder.
#[derive(Debug)]
pub(crate) enum Published {
    /// The folder is the artifact now.
    Now(Artifact),
    /// Another process published the same bytes first.
    Already(Artifact),
    /// Another process published other bytes first: the stage is not deterministic.
    Differs(Artifact, String),
}

impl Cache {
    /// True if there is a cache in `folder`.
    pub fn is_cache(folder: &Path) -> bool {
        folder.join(ROOT).is_dir()
    }

    /// Opens the cache in `folder`, and creates it if the folder is missing or empty. `rehash` reads all
    /// inputs again.
    ///
    /// # Errors
    /// Fails if the folder cannot be written, or holds other files: its tag makes backup programs skip it.
    pub fn open(folder: &Path, rehash: bool) -> Result<Self, FileError> {
        Self::with_files(folder, rehash, Arc::new(Disk))
    }

    /// Like [`open`](Self::open), with other file operations; for tests.
    pub fn with_files(folder: &Path, rehash: bool, files: Arc<dyn Files>) -> Result<Self, FileError> {
        let root = folder.join(ROOT);
        // A new disk may have these.
        let of_the_system = |name: &str| name.starts_with('.') || name == "lost+found";
        let others = |entry: &std::fs::DirEntry| !of_the_system(&entry.file_name().to_string_lossy());
        let has_others = || files::entries(folder).any(|entry| others(&entry));
        // Another process may make this very cache between the first question and the second.
        if !Self::is_cache(folder) && has_others() && !Self::is_cache(folder) {
            let other = std::io::Error::other(
                "the folder holds other files; a cache (--cache, USE3D_CACHE) needs a folder of its own, new or empty",
            );
            return files::at(folder, "make a cache of", Err(other));
        }
        files::at(&root, "create", files.create_dir_all(&root))?;
        let folder = files::at(folder, "open", std::fs::canonicalize(folder))?;
        let tag = folder.join("CACHEDIR.TAG");
        if !tag.exists() {
            files::write_atomic(files.as_ref(), &tag, TAG.as_bytes())?;
        }
        let root = folder.join(ROOT);
        for part in ["artifacts", "checkpoints", "history", "logs", "leases", "tmp"] {
            let path = root.join(part);
            if !path.is_dir() {
                files::at(&path, "create", files.create_dir_all(&path))?;
            }
        }
        let contents = Arc::new(Contents::open(files.clone(), root.join("stat-table"), rehash));
        let node = Arc::new(Node::this());
        let (verified, leases, promises, devices) = Default::default();
        Ok(Self { root, files, contents, verified, leases, node, promises, devices })
    }

    /// The same cache, used as if by another process or machine that shares it; for tests.
    #[must_use]
    pub fn as_node(self, node: Node) -> Self {
        Self { node: Arc::new(node), devices: Arc::default(), ..self }
    }

    /// Returns the same cache with a function that asks a scheduler about the tasks that leases name.
    #[must_use]
    pub fn asking(self, is_over: IsOver) -> Self {
        let node = Node { is_over: Some(is_over), ..(*self.node).clone() };
        self.as_node(node)
    }

    /// Returns the same cache with the files that stages promise, by stage. In it, an artifact without a file
    /// that its stage promises is damaged.
    #[must_use]
    pub fn with_promises(self, promises: BTreeMap<&'static str, &'static [&'static str]>) -> Self {
        Self { promises: Arc::new(promises), ..self }
    }

    /// Returns a clause that names a promised file that the manifest does not list.
    pub(crate) fn unkept(&self, manifest: &Manifest) -> Option<String> {
        let stage = manifest.ingredients.stage.as_str();
        if manifest.files.is_empty() {
            return Some("lists no files".to_string());
        }
        let names = manifest.files.iter().map(|file| file.path.as_str());
        let missing = manifest::unkept(self.promises.get(stage)?, &names)?;
        Some(format!("lists no {missing}, which every result of {stage} has"))
    }

    /// The versioned folder.
    pub fn root(&self) -> &Path {
        &self.root
    }

    pub(crate) fn files(&self) -> &dyn Files {
        self.files.as_ref()
    }

    /// The folder of a key's artifact, whether or not it exists.
    pub fn artifact_path(&self, stage: &str, key: &Key) -> PathBuf {
        self.root.join("artifacts").join(stage).join(key.to_string())
    }

    /// The folder for the checkpoints of a resumable stage.
    pub fn checkpoint_path(&self, stage: &str, key: &Digest) -> PathBuf {
        self.root.join("checkpoints").join(stage).join(key.to_string())
    }

    /// The files in the checkpoint folders of the cache in `folder`; none if there is no cache.
    pub fn checkpoints_of(folder: &Path) -> impl Iterator<Item = PathBuf> + use<> {
        let all = walkdir::WalkDir::new(folder.join(ROOT).join("checkpoints"));
        let files = all.into_iter().filter_map(Result::ok).filter(|entry| entry.file_type().is_file());
        files.map(walkdir::DirEntry::into_path)
    }

    /// Looks up a key: checks the manifest, and every file's size. A file whose times changed since it was
    /// last read is read again.
    pub fn lookup(&self, stage: &str, key: &Key) -> Result<Lookup, FileError> {
        let path = self.artifact_path(stage, key);
        let manifest_path = path.join(MANIFEST);
        let bytes = match self.files.read(&manifest_path) {
            Err(e) if files::is_absence(&e) => {
                // If the folder appeared between the two checks, its manifest is there: a folder is published
                // with it.
                if !matches!(self.files.exists(&path), Ok(true)) {
                    return Ok(Lookup::Missing);
                }
                let Ok(bytes) = self.files.read(&manifest_path) else {
                    return Ok(Lookup::Damaged(format!("{MANIFEST} is missing")));
                };
                bytes
            }
            read => files::at(&manifest_path, "read", read)?,
        };
        let manifest = match Manifest::parse(&bytes, *key) {
            Ok(manifest) => manifest,
            Err(reason) => return Ok(Lookup::Damaged(reason.to_string())),
        };
        if let Some(missing) = self.unkept(&manifest) {
            return Ok(Lookup::Damaged(format!("{MANIFEST} {missing}")));
        }
        let wrong = manifest
            .files
            .par_iter()
            .find_map_first(|file| wrong_file(file, self.contents.of_file(&path.join(&file.path))));
        Ok(match wrong {
            Some(reason) => Lookup::Damaged(reason.to_string()),
            None => Lookup::Whole(Arc::new(Artifact { path, manifest })),
        })
    }

    /// Like [`lookup`](Self::lookup), after making the file system refresh its list of names.
    pub(crate) fn lookup_again(&self, stage: &str, key: &Key) -> Result<Lookup, FileError> {
        let path = self.artifact_path(stage, key);
        path.ancestors().skip(1).take(2).for_each(|folder| self.files.look_again(folder));
        self.lookup(stage, key)
    }

    /// Looks up an artifact that another machine has made, again and again, until it is found, `enough`
    /// returns true, or more time has passed than a network file system can hide it.
    pub(crate) fn lookup_patiently(
        &self,
        stage: &str,
        key: &Key,
        enough: &dyn Fn() -> bool,
    ) -> Result<Lookup, FileError> {
        let clock = self.node.clock;
        let start = clock.now();
        let mut wait = Duration::from_millis(100);
        loop {
            let found = self.lookup_again(stage, key)?;
            if matches!(found, Lookup::Whole(_)) || enough() || clock.now() - start > LATE {
                return Ok(found);
            }
            std::thread::sleep(clock.wait_for(wait));
            wait = (2 * wait).min(Duration::from_secs(5));
        }
    }

    /// Reads every byte of an artifact and compares; the error is the first difference. The bytes are read
    /// once per process and key, unless `again` is true; the presence and sizes of the files are checked
    /// every time.
    pub fn verify(&self, artifact: &Artifact, again: bool) -> Result<(), DamagedFile> {
        let key = artifact.manifest.key;
        if !again && lock(&self.verified).contains(&key) {
            let there = artifact.manifest.files.iter().all(|file| {
                std::fs::metadata(artifact.path.join(&file.path)).is_ok_and(|found| found.len() == file.size)
            });
            if there && artifact.path.join(MANIFEST).is_file() {
                return Ok(());
            }
        }
        let wrong = artifact.manifest.files.par_iter().find_map_first(|file| {
            let path = artifact.path.join(&file.path);
            let found = files::at(&path, "read", std::fs::metadata(&path)).and_then(|metadata| {
                Ok(Content { digest: self.contents.read_digest(&path)?, bytes: metadata.len() })
            });
            wrong_file(file, found)
        });
        let mut verified = lock(&self.verified);
        match wrong {
            Some(reason) => {
                verified.remove(&key);
                Err(reason)
            }
            None => {
                verified.insert(key);
                Ok(())
            }
        }
    }

    /// A new path in `damaged/` for what lies in a key's place.
    pub(crate) fn new_damaged(&self, stage: &str, key: &Key) -> PathBuf {
        self.root.join("damaged").join(format!("{stage}-{}-{}", key.short(), files::unique()))
    }

    /// Moves the folder in a key's place to `damaged/`.
    pub(crate) fn set_aside(&self, stage: &str, key: &Key) -> Result<PathBuf, FileError> {
        let from = self.artifact_path(stage, key);
        let to = self.new_damaged(stage, key);
        files::at(folder_of(&to), "create", self.files.create_dir_all(folder_of(&to)))?;
        files::at(&from, "move aside", files::rename(self.files(), &from, &to))?;
        self.forget_fetched(key);
        lock(&self.verified).remove(key);
        Ok(to)
    }

    /// A new folder in `tmp`, owned by this process.
    pub(crate) fn scratch(&self) -> Result<PathBuf, FileError> {
        let folder = self.root.join("tmp").join(files::unique());
        files::at(&folder, "create", self.files.create_dir_all(&folder))?;
        Ok(folder)
    }

    /// Removes a folder: it is first renamed into `tmp`, so that no process finds half of it.
    pub(crate) fn discard(&self, path: &Path) -> Result<(), FileError> {
        let scratch = self.scratch()?;
        let gone = scratch.join("gone");
        let renamed = files::at(path, "remove", files::rename(self.files(), path, &gone));
        let removed = files::at(&scratch, "remove", self.files().remove_dir_all(&scratch));
        renamed.and(removed)
    }

    /// Syncs all files of a finished folder and returns their records with digests, computed in parallel.
    /// Large files that the cache has already become [links](Self::share_bytes).
    pub(crate) fn seal(&self, folder: &Path) -> Result<Vec<FileRecord>, FileError> {
        let listed = files::list(folder)?;
        let sealed: Vec<Result<FileRecord, FileError>> = listed
            .into_par_iter()
            .map(|(path, size)| {
                let file = folder.join(&path);
                let record = FileRecord { digest: self.contents.read_digest(&file)?, path, size };
                if !self.share_bytes(&file, &record) {
                    files::at(&file, "sync", self.files.sync(&file))?;
                }
                Ok(record)
            })
            .collect();
        let sealed = sealed.into_iter().collect::<Result<Vec<_>, _>>()?;
        for entry in walkdir::WalkDir::new(folder).into_iter().filter_map(Result::ok) {
            if entry.file_type().is_dir() {
                files::at(entry.path(), "sync", self.files.sync(entry.path()))?;
            }
        }
        Ok(sealed)
    }

    /// Makes the finished `folder` (in `tmp`) the artifact of `ingredients`.
    pub(crate) fn publish(
        &self,
        folder: &Path,
        ingredients: Ingredients,
        how: Circumstances,
    ) -> Result<Published, FileError> {
        let sealed = self.seal(folder)?;
        let manifest = Manifest::new(ingredients, sealed, how);
        // An earlier artifact of this key, which is gone, may have come from a store.
        self.forget_fetched(&manifest.key);
        self.put_in_place(folder, manifest)
    }

    fn fetched_mark(&self, key: &Key) -> PathBuf {
        self.root.join("fetched").join(key.to_string())
    }

    /// Removes the mark that the artifact of a key came from a store, because a computed one replaces it.
    pub(crate) fn forget_fetched(&self, key: &Key) {
        let _ = self.files.remove_file(&self.fetched_mark(key));
    }

    /// Returns true if the artifact of a key came from a store.
    pub(crate) fn was_fetched(&self, key: &Key) -> bool {
        matches!(self.files.exists(&self.fetched_mark(key)), Ok(true))
    }

    /// Makes the `folder` (in `tmp`), which holds the files of a manifest from a store, the artifact of that
    /// manifest.
    pub(crate) fn adopt(&self, folder: &Path, manifest: Manifest) -> Result<Published, FileError> {
        let mut named = manifest.files.clone();
        named.sort_by(|a, b| a.path.cmp(&b.path));
        let sealed = self.seal(folder)?;
        if sealed != named {
            let what = first_difference(&sealed, &named);
            let wrong = format!("{what} differs from what was written; check the disk");
            return files::at(folder, "publish", Err(std::io::Error::other(wrong)));
        }
        // The mark comes first, so no process finds the artifact without it.
        let mark = self.fetched_mark(&manifest.key);
        files::at(folder_of(&mark), "create", self.files.create_dir_all(folder_of(&mark)))?;
        files::at(&mark, "write", files::create_own(self.files(), &mark, b""))?;
        self.put_in_place(folder, manifest)
    }

    fn put_in_place(&self, folder: &Path, manifest: Manifest) -> Result<Published, FileError> {
        let record = folder.join(MANIFEST);
        let bytes = serde_json::to_vec_pretty(&manifest).map_err(std::io::Error::other);
        files::at(&record, "write", bytes.and_then(|bytes| self.files.write(&record, &bytes)))?;
        files::at(folder, "sync", self.files.sync(folder))?;
        let stage = manifest.ingredients.stage.clone();
        let place = self.artifact_path(&stage, &manifest.key);
        let parent = self.root.join("artifacts").join(&stage);
        files::at(&parent, "create", self.files.create_dir_all(&parent))?;
        if let Err(source) = self.files.rename(folder, &place) {
            // Another process was first, something damaged is in the way, or the rename succeeded and its
            // reply was lost.
            let taken = matches!(source.kind(), ErrorKind::AlreadyExists | ErrorKind::DirectoryNotEmpty);
            let found = if taken || matches!(self.files.exists(folder), Ok(false)) {
                self.lookup_patiently(&stage, &manifest.key, &|| false)?
            } else {
                self.lookup_again(&stage, &manifest.key)?
            };
            match found {
                Lookup::Whole(first) if first.manifest.content == manifest.content => {
                    return Ok(Published::Already(Arc::unwrap_or_clone(first)));
                }
                Lookup::Whole(first) => {
                    let which = first_difference(&first.manifest.files, &manifest.files);
                    return Ok(Published::Differs(Arc::unwrap_or_clone(first), which));
                }
                Lookup::Damaged(_) => {
                    self.set_aside(&stage, &manifest.key)?;
                    files::at(&place, "publish", files::rename(self.files(), folder, &place))?;
                }
                Lookup::Missing => return files::at(&place, "publish", Err(source)),
            }
        }
        files::at(&parent, "sync", self.files.sync(&parent))?;
        for file in &manifest.files {
            self.contents.remember_own(&place.join(&file.path), file.digest);
        }
        lock(&self.verified).insert(manifest.key);
        Ok(Published::Now(Artifact { path: place, manifest }))
    }

    /// Marks an artifact as used now, which sets its order in cleaning up. A failure is harmless.
    pub(crate) fn touch(&self, artifact: &Path) {
        if let Ok(folder) = std::fs::File::open(artifact) {
            let _ = folder.set_modified(SystemTime::now());
        }
    }

    /// Lists every artifact folder as stage, key and path, sorted.
    pub fn artifacts(&self) -> Vec<(String, Key, PathBuf)> {
        let mut out = Vec::new();
        for stage in files::entries(&self.root.join("artifacts")) {
            for entry in files::entries(&stage.path()) {
                if let Ok(key) = entry.file_name().to_string_lossy().parse() {
                    out.push((stage.file_name().to_string_lossy().into_owned(), key, entry.path()));
                }
            }
        }
        out.sort();
        out
    }
}

/// A file of an artifact that is not as it was written.
#[derive(Debug, thiserror::Error)]
pub enum DamagedFile {
    /// The file is gone.
    #[error("{0} is missing")]
    Missing(String),
    /// The file cannot be read.
    #[error(transparent)]
    Unreadable(FileError),
    /// The file has another size, bytes, than it had when it was written.
    #[error("{0} has {1} bytes, {2} were written")]
    Size(String, u64, u64),
    /// The file has other bytes.
    #[error("the bytes of {0} have changed")]
    Changed(String),
}

fn wrong_file(file: &FileRecord, found: Result<Content, FileError>) -> Option<DamagedFile> {
    let path = file.path.clone();
    match found {
        Err(error) if error.source.kind() == std::io::ErrorKind::NotFound => Some(DamagedFile::Missing(path)),
        Err(error) => Some(DamagedFile::Unreadable(error)),
        Ok(Content { bytes, .. }) if bytes != file.size => Some(DamagedFile::Size(path, bytes, file.size)),
        Ok(found) if found.digest != file.digest => Some(DamagedFile::Changed(path)),
        Ok(_) => None,
    }
}

/// Returns the path of the first file in which two artifacts differ.
pub(crate) fn first_difference(a: &[FileRecord], b: &[FileRecord]) -> String {
    let paths: BTreeSet<&str> = a.iter().chain(b).map(|f| f.path.as_str()).collect();
    let of = |files: &[FileRecord], path: &str| files.iter().find(|f| f.path == path).cloned();
    let differs = paths.into_iter().find(|path| of(a, path) != of(b, path));
    differs.map_or_else(|| "nothing".to_string(), String::from)
}
