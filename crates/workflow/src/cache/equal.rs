//! Equal bytes that are stored once.
//!
//! A large file of a new artifact becomes a hard link to an equal file of another artifact: the Gaussians of
//! stage 2, which are those of stage 1, take no space. The stat table names the files with the same digest,
//! and the one that is linked is read first, so that a damaged file is never shared. Only the cache has hard
//! links, because nobody edits its files. Results are copies: some programs save into the file that they
//! opened. File systems that share blocks between copies (Btrfs, XFS, APFS) store these once, too.
//!
//! A file system without hard links keeps every copy.

use std::path::{Path, PathBuf};

use crate::cache::artifacts::Cache;
use crate::cache::files;
use crate::cache::manifest::FileRecord;

/// The least size of a file that is shared, in bytes. A link costs about as much as a small file.
const LEAST: u64 = 1 << 16;

impl Cache {
    /// Makes `path`, a file of an unfinished artifact or the place of one, a hard link to an equal file of
    /// the cache. Returns false if there is none; then nothing has changed.
    pub(crate) fn share_bytes(&self, path: &Path, file: &FileRecord) -> bool {
        if file.size < LEAST {
            return false;
        }
        // A file from a store became a link when it was fetched.
        if std::fs::symlink_metadata(path).is_ok_and(|found| files::linked(&found).is_some()) {
            return true;
        }
        let is_whole =
            |place: &&PathBuf| self.contents.read_digest(place).is_ok_and(|digest| digest == file.digest);
        let equal = self.contents.places_of(&file.digest, &self.root().join("artifacts"));
        let Some(place) = equal.iter().find(is_whole) else { return false };
        let link = files::sibling(path, &files::unique());
        if std::fs::hard_link(place, &link).is_err() {
            return false;
        }
        let renamed = files::rename(self.files(), &link, path).is_ok();
        if !renamed {
            let _ = self.files().remove_file(&link);
        }
        // A link changes the time of change of all links of this file, but not its bytes.
        self.contents.remember_links(place, file.digest);
        renamed
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cache::artifacts::{Artifact, Lookup, Published};
    use crate::cache::key::Ingredients;
    use crate::cache::manifest::{Circumstances, MANIFEST};
    use crate::gc::CleanOptions;

    fn publish(cache: &Cache, seed: u64, bytes: &[u8]) -> Artifact {
        let ingredients: Ingredients = serde_json::from_value(serde_json::json!({
            "stage": "train", "version": 1, "code": {}, "third_party": {}, "parameters": {},
            "seed": seed, "numeric_class": "x", "inputs": []
        }))
        .unwrap();
        let folder = cache.scratch().unwrap().join("artifact");
        std::fs::create_dir_all(folder.join("deep")).unwrap();
        std::fs::write(folder.join("deep/gaussians"), bytes).unwrap();
        std::fs::write(folder.join("note"), "small").unwrap();
        match cache.publish(&folder, ingredients, Circumstances::default()).unwrap() {
            Published::Now(artifact) => artifact,
            other => panic!("{other:?}"),
        }
    }

    fn number(artifact: &Artifact, name: &str) -> Option<(u64, u64)> {
        files::identity(&std::fs::symlink_metadata(artifact.path.join(name)).ok()?)
    }

    #[test]
    #[cfg(unix)]
    fn equal_files_of_a_cache_are_one_file_and_a_damaged_one_is_not_shared() {
        let dir = tempfile::tempdir().unwrap();
        let cache = Cache::open(&dir.path().join("cache"), false).unwrap();
        let bytes = vec![7u8; 100_000];
        let (first, second) = (publish(&cache, 1, &bytes), publish(&cache, 2, &bytes));
        let large = "deep/gaussians";
        assert_eq!(number(&first, large), number(&second, large));
        assert_ne!(number(&first, "note"), number(&second, "note"), "small files stay apart");
        // The first is not read again although its time of change is another.
        let Lookup::Whole(_) = cache.lookup("train", &first.manifest.key).unwrap() else { panic!("whole") };
        cache.verify(&second, true).unwrap();
        // A file that was damaged on the disk is not shared with a good one.
        std::fs::write(first.path.join(large), vec![8u8; 100_000]).unwrap();
        let third = publish(&cache, 3, &bytes);
        assert_ne!(number(&first, large), number(&third, large));
        cache.verify(&third, true).unwrap();
        // Space that several artifacts share is free when the last of them goes.
        let alone = publish(&cache, 4, &vec![9u8; 100_000]);
        let options = CleanOptions { max_bytes: Some(150_000), ..CleanOptions::default() };
        let total = cache.clean(&CleanOptions::default()).left;
        assert!((300_000..310_000).contains(&total), "{total}");
        let cleaning = cache.clean(&options);
        assert!(cleaning.left <= 150_000, "{}", cleaning.left);
        let freed: u64 = cleaning.removed.iter().map(|item| item.bytes).sum();
        assert_eq!(freed + cleaning.left, total);
        let left: Vec<PathBuf> = [&first, &second, &third, &alone].map(|a| a.path.join(MANIFEST)).into();
        assert!(left.iter().filter(|manifest| manifest.is_file()).count() <= 2);
    }
}
