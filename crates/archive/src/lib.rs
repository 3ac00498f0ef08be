//! Zip and tar archives, as owners of data pack them: the names of their files, and unpacking of chosen ones.
//!
//! An archive comes from outside. Names that lead out of the target folder are refused, and links are left
//! out.

use std::fs::File;
use std::io::{self, BufReader, ErrorKind, Read};
use std::path::{Component, Path, PathBuf};

use flate2::read::GzDecoder;

/// The endings of archives, the longest first.
const ENDINGS: [&str; 4] = [".tar.gz", ".tgz", ".tar", ".zip"];

/// The name of an archive without its ending; `None` if the file's name does not end like an archive's.
pub fn stem(path: &Path) -> Option<&str> {
    let name = path.file_name()?.to_str()?;
    let split = |ending: &&str| {
        let at = name.len().checked_sub(ending.len())?;
        let (stem, end) = (name.get(..at)?, name.get(at..)?);
        (end.eq_ignore_ascii_case(ending) && !stem.is_empty()).then_some(stem)
    };
    ENDINGS.iter().find_map(split)
}

/// True if a file's name ends like an archive's.
pub fn is_archive(path: &Path) -> bool {
    stem(path).is_some()
}

/// True if an archive has a list of its files. Without one, all of it must be read to know them.
pub fn has_list(path: &Path) -> bool {
    path.extension().is_some_and(|end| end.eq_ignore_ascii_case("zip"))
}

/// The names of the files in an archive.
///
/// # Errors
/// The archive cannot be read.
pub fn names(path: &Path) -> io::Result<Vec<String>> {
    if has_list(path) {
        let zip = zip::ZipArchive::new(File::open(path)?).map_err(damaged)?;
        let names = zip.file_names().map(|name| name.map(|name| name.into_owned()).map_err(damaged));
        return names.filter(|name| name.as_ref().map_or(true, |name| !name.ends_with('/'))).collect();
    }
    let mut names = Vec::new();
    each_of_tar(path, &mut |name, _| {
        names.push(name.to_string());
        Ok(())
    })?;
    Ok(names)
}

/// Unpacks files of an archive into a folder. `target` gives the place of a file below the folder; `None`
/// leaves it out. `begin` is called before each file, and its error ends the work. Returns the number of
/// files.
///
/// # Errors
/// The archive cannot be read, a name leads out of the folder, or a file cannot be written.
pub fn unpack(
    path: &Path,
    folder: &Path,
    target: &dyn Fn(&str) -> Option<PathBuf>,
    begin: &mut dyn FnMut(&str) -> io::Result<()>,
) -> io::Result<usize> {
    let mut count = 0;
    let mut take = |name: &str, bytes: &mut dyn Read| {
        let Some(to) = target(name) else { return Ok(()) };
        if !to.components().all(|part| matches!(part, Component::Normal(_))) {
            let reason = format!("the name {name:?} leads out of its folder");
            return Err(io::Error::new(ErrorKind::InvalidData, reason));
        }
        begin(name)?;
        let to = folder.join(to);
        to.parent().map_or(Ok(()), std::fs::create_dir_all)?;
        let mut file = File::create_new(&to).map_err(|e| named(&to, &e))?;
        io::copy(bytes, &mut file)?;
        count += 1;
        Ok(())
    };
    if has_list(path) {
        let mut zip = zip::ZipArchive::new(BufReader::new(File::open(path)?)).map_err(damaged)?;
        for i in 0..zip.len() {
            let mut file = zip.by_index(i).map_err(damaged)?;
            if file.is_file() {
                let name = file.name().map_err(damaged)?.into_owned();
                take(&name, &mut file)?;
            }
        }
    } else {
        each_of_tar(path, &mut take)?;
    }
    Ok(count)
}

/// Calls `take` with the name and the bytes of each file of a tar archive.
fn each_of_tar(path: &Path, take: &mut dyn FnMut(&str, &mut dyn Read) -> io::Result<()>) -> io::Result<()> {
    let file = BufReader::new(File::open(path)?);
    let plain = path.extension().is_some_and(|end| end.eq_ignore_ascii_case("tar"));
    let bytes: Box<dyn Read> = if plain { Box::new(file) } else { Box::new(GzDecoder::new(file)) };
    let mut archive = tar::Archive::new(bytes);
    for entry in archive.entries()? {
        let mut entry = entry?;
        if entry.header().entry_type().is_file() {
            let name = entry.path()?.to_string_lossy().into_owned();
            take(&name, &mut entry)?;
        }
    }
    Ok(())
}

fn damaged(error: zip::result::ZipError) -> io::Error {
    match error {
        zip::result::ZipError::Io(error) => error,
        error => io::Error::new(ErrorKind::InvalidData, error),
    }
}

fn named(path: &Path, error: &io::Error) -> io::Error {
    io::Error::new(error.kind(), format!("{}: {error}", path.display()))
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    fn archives(dir: &Path) -> [PathBuf; 2] {
        let files = [("set/Panama/images_wb/a.png", "a"), ("set/Panama/sparse/0/b.bin", "b"), ("set/x", "x")];
        let zipped = dir.join("set.ZIP");
        let mut zip = zip::ZipWriter::new(File::create(&zipped).unwrap());
        let gzipped = dir.join("set.tar.gz");
        let gzip = flate2::write::GzEncoder::new(File::create(&gzipped).unwrap(), Default::default());
        let mut tar = tar::Builder::new(gzip);
        for (name, text) in files {
            zip.start_file(name, zip::write::SimpleFileOptions::default()).unwrap();
            zip.write_all(text.as_bytes()).unwrap();
            let mut header = tar::Header::new_gnu();
            header.set_size(text.len() as u64);
            header.set_mode(0o644);
            tar.append_data(&mut header, name, text.as_bytes()).unwrap();
        }
        zip.finish().unwrap();
        tar.into_inner().unwrap().finish().unwrap();
        [zipped, gzipped]
    }

    #[test]
    fn chosen_files_are_unpacked_and_no_name_leads_out() {
        let dir = tempfile::tempdir().unwrap();
        for (n, archive) in archives(dir.path()).iter().enumerate() {
            assert_eq!(stem(archive), Some("set"));
            assert_eq!(names(archive).unwrap().len(), 3);
            let folder = dir.path().join(n.to_string());
            let target = |name: &str| name.strip_prefix("set/Panama/").map(PathBuf::from);
            assert_eq!(unpack(archive, &folder, &target, &mut |_| Ok(())).unwrap(), 2);
            assert_eq!(std::fs::read_to_string(folder.join("sparse/0/b.bin")).unwrap(), "b");
            assert!(!folder.join("x").exists());
            // A second file of one name is an error, and so is a place outside.
            assert!(unpack(archive, &folder, &target, &mut |_| Ok(())).is_err());
            let out = |_: &str| Some(PathBuf::from("../out"));
            let said = unpack(archive, &folder, &out, &mut |_| Ok(())).unwrap_err().to_string();
            assert!(said.contains("leads out"), "{said}");
            assert!(!dir.path().join("out").exists());
        }
        assert!(!is_archive(Path::new("a.gz")) && !is_archive(Path::new(".zip")));
        std::fs::write(dir.path().join("b.zip"), "no archive").unwrap();
        assert!(names(&dir.path().join("b.zip")).is_err());
    }
}
