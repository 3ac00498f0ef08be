//! The scenes of an entry of a pipeline file: one with a name, or one for each folder or film that a pattern
//! matches.

use std::collections::BTreeSet;
use std::path::Path;

use glob::{MatchOptions, Pattern, glob_with};
use use3d_workflow::graph::External;

use super::document::{ConfigError, join};
use super::file::SceneEntry;
use super::places::{expand, lacks_cameras};
use super::{NamedPlace, Reader};

/// Stars stand for parts of one name, and hidden folders have to be written out.
const MATCHING: MatchOptions =
    MatchOptions { case_sensitive: true, require_literal_separator: true, require_literal_leading_dot: true };

impl Reader<'_> {
    /// The names of an entry's scenes with their captures or footage, in their order. Those whose names are
    /// among `by_hand` are left out: an entry of their own describes them.
    pub(super) fn scenes_of(
        &self,
        base: &str,
        entry: &SceneEntry,
        folder: &Path,
        by_hand: &BTreeSet<String>,
    ) -> Result<Vec<NamedPlace>, ConfigError> {
        let needs = |key: &str| self.document.error(base, format!("[[scene]] needs `{key}`"));
        let Some(pattern) = &entry.from else {
            let name = entry.name.as_ref().ok_or_else(|| needs("name"))?;
            if entry.download.is_some() && (entry.capture.is_some() || entry.footage.is_some()) {
                let message = "`download` finds the scene's files itself; leave it or the other one out";
                return Err(self.document.key_error(&join(base, "download"), message));
            }
            if entry.capture.is_some() && entry.footage.is_some() {
                let message = "`footage` has no cameras yet, and `capture` has them; leave one of them out";
                return Err(self.document.key_error(&join(base, "footage"), message));
            }
            if let Some(recipe) = entry.download {
                let (is_footage, place) = self.downloads.find(recipe, name, folder);
                return Ok(vec![NamedPlace { name: name.clone(), is_footage, place }]);
            }
            let place = entry.capture.as_ref().or(entry.footage.as_ref());
            let place = place.ok_or_else(|| needs("capture` or `footage"))?;
            let name = name.clone();
            return Ok(vec![NamedPlace {
                name,
                is_footage: entry.footage.is_some(),
                place: expand(place, folder),
            }]);
        };
        let given = [
            ("name", entry.name.is_some()),
            ("capture", entry.capture.is_some()),
            ("footage", entry.footage.is_some()),
            ("download", entry.download.is_some()),
        ];
        if let Some((key, _)) = given.iter().find(|(_, given)| *given) {
            let message = format!(
                "`from` makes a scene of every folder or film and names it like that, so `{key}` has no place here; leave one \
                 of them out"
            );
            return Err(self.document.key_error(&join(base, key), message));
        }
        let path = join(base, "from");
        let wrong = |message: String| self.document.error(&path, message);
        let mut place = expand(pattern, Path::new("")).map_err(wrong)?;
        if place.is_relative() {
            // Only the file's own text is a pattern.
            place = Path::new(&Pattern::escape(&folder.to_string_lossy())).join(place);
        }
        let found = glob_with(&place.to_string_lossy(), MATCHING);
        let found =
            found.map_err(|e| wrong(format!("`{pattern}` is no pattern of folders and films: {}", e.msg)))?;
        let mut scenes: Vec<NamedPlace> = Vec::new();
        let mut films = Vec::new();
        let (mut any, mut taken) = (false, by_hand.clone());
        for path in found {
            let path = path.map_err(|e| wrong(format!("{}: {}", e.path().display(), e.error())))?;
            let is_film = !path.is_dir();
            if is_film && !(use3d_prepare::is_film(&path) && use3d_prepare::is_input(&path)) {
                continue;
            }
            any = true;
            let name = if is_film { path.file_stem() } else { path.file_name() };
            let name = name.and_then(|name| name.to_str()).map(String::from);
            let name = name.ok_or_else(|| wrong(format!("{}: its name is no text", path.display())))?;
            if is_film {
                films.push((name, path));
            } else if !by_hand.contains(&name) {
                taken.insert(name.clone());
                scenes.push(NamedPlace { name, is_footage: lacks_cameras(&path), place: Ok(path) });
            }
        }
        if !any {
            return Err(wrong(format!(
                "no folder or film matches `{pattern}`; every one that matches becomes a scene, so check the path, or \
                 leave this entry out until there is one"
            )));
        }
        // The folder of a film's name is its capture.
        let films = films.into_iter().filter(|(name, _)| !taken.contains(name));
        scenes.extend(films.map(|(name, path)| NamedPlace { name, is_footage: true, place: Ok(path) }));
        scenes.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(scenes)
    }

    /// Refuses a scene's name that is no name, or that another scene has.
    pub(super) fn scene_name(
        &self,
        base: &str,
        (name, place): (&str, &External),
        before: &[use3d_workflow::BatchScene],
    ) -> Result<(), ConfigError> {
        let from = join(base, "from");
        let (Ok(place), true) = (place, self.document.has(&from)) else {
            return self.unique(base, name, before.iter().map(|s| &s.name));
        };
        self.name(&from, name)?;
        let Some(other) = before.iter().find(|scene| scene.name == name) else { return Ok(()) };
        let mut others = ["capture", "footage"].iter().filter_map(|kind| other.externals.get(*kind));
        let other = others.next().and_then(|place| place.as_ref().ok());
        let message = format!(
            "two folders or films have the name `{name}`: {} and {}; give one of them a [[scene]] with a name of its own, and keep \
             it out of the pattern",
            other.map_or_else(String::new, |path| path.display().to_string()),
            place.display()
        );
        Err(self.document.error(&from, message))
    }
}
