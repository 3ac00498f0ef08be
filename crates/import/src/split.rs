//! The choice of held-out views (R8): every `every`-th in file-name order, beginning with the first, unless
//! lists define the split.

use std::collections::BTreeMap;
use std::path::Path;

use use3d_capture::{Split, View, stem};

use crate::error::ImportError;
use crate::folder::last_part;
use crate::params::{SplitOrder, SplitParams};

/// The split, with a text on the rule by which it was made.
pub(crate) struct Chosen {
    /// False if lists define the split.
    pub(crate) counted: bool,
    pub(crate) rule: String,
    pub(crate) split: Split,
    pub(crate) notes: Vec<String>,
}

/// Chooses the split of views in file-name order. `skipped` are names that are in the model but not on disk,
/// and `held_out` the ids of images that the model's files hold out.
pub(crate) fn choose(
    root: &Path,
    views: &[View],
    skipped: &[String],
    held_out: &[u32],
    params: &SplitParams,
) -> Result<Chosen, ImportError> {
    if params.order == SplitOrder::Owners {
        return from_owners(root, views);
    }
    if params.lists {
        let train = List::read(&root.join("train_list.txt"))?;
        let test = List::read(&root.join("test_list.txt"))?;
        if train.is_some() || test.is_some() {
            return from_lists(views, skipped, train.as_ref(), test.as_ref());
        }
        let (test, train): (Vec<usize>, Vec<usize>) =
            (0..views.len()).partition(|i| held_out.contains(&views[*i].id));
        if !test.is_empty() && !train.is_empty() {
            let rule = "given by the model's files".to_string();
            return Ok(Chosen { counted: false, rule, split: Split { train, test }, notes: Vec::new() });
        }
    }
    let mut order: Vec<usize> = (0..views.len()).collect();
    let by = match params.order {
        SplitOrder::Name | SplitOrder::Owners => "file name",
        SplitOrder::ColmapId => {
            order.sort_by_key(|&i| views[i].id);
            "COLMAP image id"
        }
    };
    let counted = Split::every(views.len(), params.every);
    let pick = |indices: Vec<usize>| {
        let mut picked: Vec<usize> = indices.into_iter().map(|i| order[i]).collect();
        picked.sort_unstable();
        picked
    };
    let rule = match params.every {
        0 => "no view is held out".to_string(),
        n => format!("one view in {n} is held out, counted by {by} from the first"),
    };
    let split = Split { train: pick(counted.train), test: pick(counted.test) };
    Ok(Chosen { counted: true, rule, split, notes: Vec::new() })
}

/// The held-out photographs of the scenes of SeaThru-NeRF, as an author of it named them in issue 15 of
/// github.com/deborahLevy130/seathru_NeRF. The issue has 1034 for the last one of Curasao, which has no such
/// photograph; 1304 is the one that its rule gives, every eighth by name.
const OWNERS: [(&str, &[&str]); 4] = [
    ("IUI3-RedSea", &["MTN_5894", "MTN_5903", "MTN_5911", "MTN_5928"]),
    ("Curasao", &["MTN_1288", "MTN_1296", "MTN_1304"]),
    ("JapaneseGradens-RedSea", &["MTN_1090", "MTN_1098", "MTN_1106"]),
    ("Panama", &["MTN_1529", "MTN_1539", "MTN_1547"]),
];

/// The split that the owners of the photographs published.
fn from_owners(root: &Path, views: &[View]) -> Result<Chosen, ImportError> {
    let at = |name: &str| views.iter().position(|view| stem(last_part(&view.name)) == name);
    let known = |list: &[&str]| list.iter().map(|name| at(name)).collect::<Option<Vec<usize>>>();
    let Some((scene, mut test)) = OWNERS.iter().find_map(|(scene, list)| Some((scene, known(list)?))) else {
        let reason = "split.order is \"owners\", and no published list of held-out views fits these photographs; \
                      lists are known for the four scenes of SeaThru-NeRF";
        return Err(ImportError::List { path: root.to_path_buf(), reason: reason.into() });
    };
    test.sort_unstable();
    let train = (0..views.len()).filter(|i| test.binary_search(i).is_err()).collect();
    let rule = format!("the views that the authors of SeaThru-NeRF hold out in {scene}");
    Ok(Chosen { counted: false, rule, split: Split { train, test }, notes: Vec::new() })
}

/// The names in a list file: one per line, `#` begins a comment.
struct List {
    file: std::path::PathBuf,
    names: Vec<String>,
}

impl List {
    fn read(path: &Path) -> Result<Option<Self>, ImportError> {
        if !path.is_file() {
            return Ok(None);
        }
        let bytes = std::fs::read(path).map_err(ImportError::file(path))?;
        let text = use3d_survey::text(&bytes).map_err(|(line, reason)| ImportError::List {
            path: path.to_path_buf(),
            reason: format!("line {line}: {reason}, with one image name per line"),
        })?;
        let names = text
            .lines()
            .map(|l| l.trim().replace('\\', "/"))
            .filter(|l| !l.is_empty() && !l.starts_with('#'))
            .collect();
        Ok(Some(Self { file: path.to_path_buf(), names }))
    }

    fn name(&self) -> String {
        self.file.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default()
    }

    /// Indices of the views that the list names: by name, by file name without folders, or by stem.
    fn indices(
        &self,
        views: &[View],
        skipped: &[String],
        notes: &mut Vec<String>,
    ) -> Result<Vec<usize>, ImportError> {
        let keys: [fn(&str) -> &str; 4] = [|n| n, stem, last_part, |n| stem(last_part(n))];
        // A key that two views share identifies neither of them.
        let tables = keys.map(|key| {
            let mut table: BTreeMap<&str, Option<usize>> = BTreeMap::new();
            for (i, view) in views.iter().enumerate() {
                table.entry(key(&view.name)).and_modify(|v| *v = None).or_insert(Some(i));
            }
            table
        });
        let (mut indices, mut unknown) = (Vec::new(), Vec::new());
        for name in &self.names {
            let found =
                keys.iter().zip(&tables).find_map(|(key, table)| table.get(key(name)).copied().flatten());
            match found {
                Some(i) => indices.push(i),
                None => unknown.push(name.as_str()),
            }
        }
        if indices.is_empty() && !self.names.is_empty() {
            let reason = format!(
                "none of its {} names is an image of this capture (the first is {:?}); expected one image name per line",
                self.names.len(),
                self.names[0]
            );
            return Err(ImportError::List { path: self.file.clone(), reason });
        }
        if !unknown.is_empty() {
            let missing = unknown.iter().filter(|n| skipped.iter().any(|s| s == *n)).count();
            notes.push(format!(
                "{}: {} of its names are not among the views ({missing} of them are missing images): {}",
                self.name(),
                unknown.len(),
                crate::report::some(&unknown)
            ));
        }
        indices.sort_unstable();
        indices.dedup();
        Ok(indices)
    }
}

fn from_lists(
    views: &[View],
    skipped: &[String],
    train: Option<&List>,
    test: Option<&List>,
) -> Result<Chosen, ImportError> {
    let mut notes = Vec::new();
    let mut read = |list: Option<&List>| list.map(|l| l.indices(views, skipped, &mut notes)).transpose();
    let (train_indices, test_indices) = (read(train)?, read(test)?);
    let rest = |of: &[usize]| (0..views.len()).filter(|i| of.binary_search(i).is_err()).collect::<Vec<_>>();
    let names: Vec<String> = [train, test].into_iter().flatten().map(List::name).collect();
    let split = match (train_indices, test_indices) {
        (Some(train), Some(test)) => Split { train, test },
        (Some(train), None) => Split { test: rest(&train), train },
        (None, Some(test)) => Split { train: rest(&test), test },
        (None, None) => Split::default(),
    };
    if let Some(&both) = split.train.iter().find(|i| split.test.binary_search(i).is_ok()) {
        let name = &views[both].name;
        return Err(ImportError::List {
            path: test.map(|t| t.file.clone()).unwrap_or_default(),
            reason: format!("{name:?} is in train_list.txt too; a view can be in one of them only"),
        });
    }
    let unused = views.len() - split.train.len() - split.test.len();
    if unused > 0 {
        notes.push(format!("{unused} views are in neither list and are not used"));
    }
    Ok(Chosen { counted: false, rule: format!("given by {}", names.join(" and ")), split, notes })
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_capture::{Camera, Intrinsics, Pose};

    fn views(names: &[&str]) -> Vec<View> {
        let intrinsics = Intrinsics { width: 1, height: 1, fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 };
        let view = |(i, name): (usize, &&str)| View {
            name: use3d_capture::FileName::new(name).unwrap(),
            id: 100 - i as u32,
            image: "x".into(),
            mask: None,
            depth_prior: None,
            camera: Camera { intrinsics, pose: Pose::IDENTITY },
        };
        names.iter().enumerate().map(view).collect()
    }

    #[test]
    fn ids_can_count_instead_of_names() {
        let dir = tempfile::tempdir().unwrap();
        let views = views(&["a", "b", "c", "d", "e"]);
        let by_name = SplitParams { every: 4, ..SplitParams::default() };
        assert_eq!(choose(dir.path(), &views, &[], &[], &by_name).unwrap().split.test, [0, 4]);
        let by_id = SplitParams { every: 4, order: SplitOrder::ColmapId, ..SplitParams::default() };
        // Ids decrease as names increase: the first by id is "e", the fifth is "a".
        assert_eq!(choose(dir.path(), &views, &[], &[], &by_id).unwrap().split.test, [0, 4]);
        let by_id = SplitParams { every: 3, ..by_id };
        assert_eq!(choose(dir.path(), &views, &[], &[], &by_id).unwrap().split.test, [1, 4]);
        let none = SplitParams { every: 0, ..by_name };
        assert_eq!(choose(dir.path(), &views, &[], &[], &none).unwrap().split.train.len(), 5);
    }

    #[test]
    fn the_owners_list_is_found_by_its_photographs() {
        let dir = tempfile::tempdir().unwrap();
        let params = SplitParams { order: SplitOrder::Owners, ..SplitParams::default() };
        let names = ["MTN_1280.png", "MTN_1288.png", "MTN_1296.png", "MTN_1304.png"];
        let chosen = choose(dir.path(), &views(&names), &[], &[], &params).unwrap();
        assert_eq!((chosen.split.train, chosen.split.test), (vec![0], vec![1, 2, 3]));
        assert!(chosen.rule.contains("Curasao"), "{}", chosen.rule);
        let said = choose(dir.path(), &views(&names[..2]), &[], &[], &params).err().unwrap().to_string();
        assert!(said.contains("four scenes of SeaThru-NeRF"), "{said}");
    }

    #[test]
    fn lists_decide_and_contradictions_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| std::fs::write(dir.path().join(name), text).unwrap();
        let views = views(&["l/a.png", "l/b.png", "r/a.png", "r/c.png"]);
        let choose = |params: &SplitParams| choose(dir.path(), &views, &["gone.png".into()], &[], params);
        let params = SplitParams::default();
        write("test_list.txt", "# held out\n\nl/b.png\r\ngone.png\nc\n");
        let chosen = choose(&params).unwrap();
        assert_eq!((chosen.split.train, chosen.split.test), (vec![0, 2], vec![1, 3]));
        assert!(chosen.notes[0].contains("gone.png") && chosen.notes[0].contains("1 of them are missing"));
        write("train_list.txt", "l\\a.png\n");
        let chosen = choose(&params).unwrap();
        assert_eq!((chosen.split.train, chosen.split.test), (vec![0], vec![1, 3]));
        assert!(chosen.notes.iter().any(|n| n.contains("1 views are in neither")), "{:?}", chosen.notes);
        write("train_list.txt", "\u{feff}l/a.png\nr/a.png\n");
        let chosen = choose(&params).unwrap();
        assert_eq!((chosen.split.train, chosen.notes.len()), (vec![0, 2], 1), "{:?}", chosen.notes);
        write("train_list.txt", "l/b.png\n");
        assert!(choose(&params).err().unwrap().to_string().contains("l/b.png"));
        // The name is ambiguous without its folder.
        write("train_list.txt", "a.png\n");
        assert!(choose(&params).is_err());
        assert_eq!(choose(&SplitParams { lists: false, ..params }).unwrap().split.test, [0]);
    }
}
