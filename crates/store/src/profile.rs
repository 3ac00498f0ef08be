//! Keys, region and server of a bucket from the files of the cloud's own tools.
//!
//! `~/.aws/credentials` and `~/.aws/config` (`AWS_SHARED_CREDENTIALS_FILE`, `AWS_CONFIG_FILE`) have a section
//! for each profile; `AWS_PROFILE` names the one to use, else it is `default`. Variables of the environment
//! come before the files. Profiles whose keys come from another program or from single sign-on are refused
//! with the command that gives the keys.

use std::io;
use std::path::{Path, PathBuf};

use ini::Ini;

/// The names in the files, and the variables that stand for them.
const READ: [(&str, &str); 5] = [
    ("aws_access_key_id", "AWS_ACCESS_KEY_ID"),
    ("aws_secret_access_key", "AWS_SECRET_ACCESS_KEY"),
    ("aws_session_token", "AWS_SESSION_TOKEN"),
    ("region", "AWS_REGION"),
    ("endpoint_url", "AWS_ENDPOINT_URL"),
];
/// Settings that lead to keys elsewhere.
const ELSEWHERE: [&str; 5] =
    ["credential_process", "sso_session", "sso_start_url", "source_profile", "web_identity_token_file"];

/// The settings of the profile in use as variables, where the environment does not set them.
///
/// # Errors
/// A file cannot be read, `AWS_PROFILE` names no profile, or the keys of the profile lie elsewhere.
pub(crate) fn settings(variable: &dyn Fn(&str) -> Option<String>) -> io::Result<Vec<(&'static str, String)>> {
    let home = variable("HOME").or_else(|| variable("USERPROFILE"));
    let file = |name: &str, own: &str| {
        let usual = || home.as_ref().map(|home| Path::new(home).join(".aws").join(own));
        variable(name).map(PathBuf::from).or_else(usual)
    };
    let profile = variable("AWS_PROFILE").filter(|name| !name.is_empty());
    let name = profile.as_deref().unwrap_or("default");
    let of_config = if name == "default" { name.to_string() } else { format!("profile {name}") };
    let files = [
        (file("AWS_SHARED_CREDENTIALS_FILE", "credentials"), name),
        (file("AWS_CONFIG_FILE", "config"), of_config.as_str()),
    ];
    let (mut found, mut sections) = (Vec::new(), 0);
    // Keys of the environment are used as they are: half of them may not come from a file.
    let has_keys = variable("AWS_ACCESS_KEY_ID").is_some();
    for (path, section) in files {
        let Some(path) = path.filter(|path| path.is_file()) else { continue };
        let wrong = |e: ini::Error| io::Error::other(format!("{}: {e}; correct the file", path.display()));
        let file = Ini::load_from_file_noescape(&path).map_err(wrong)?;
        let Some(section) = file.section(Some(section)) else { continue };
        sections += 1;
        if let Some(setting) = ELSEWHERE.iter().find(|name| !has_keys && section.contains_key(name)) {
            return Err(io::Error::other(format!(
                "{}: profile {name} has `{setting}`, which is not read; set the variables that `aws configure \
                 export-credentials --format env --profile {name}` prints",
                path.display()
            )));
        }
        for (key, variable_of_it) in READ {
            let is_key = key.starts_with("aws_");
            let known =
                variable(variable_of_it).is_some() || found.iter().any(|(name, _)| *name == variable_of_it);
            if let Some(value) = section.get(key).filter(|_| !(known || is_key && has_keys)) {
                found.push((variable_of_it, value.to_string()));
            }
        }
    }
    match profile {
        Some(name) if sections == 0 && !has_keys => Err(io::Error::other(format!(
            "AWS_PROFILE is {name}, and neither ~/.aws/credentials nor ~/.aws/config has this profile"
        ))),
        _ => Ok(found),
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

    #[test]
    fn keys_are_found_where_the_clouds_own_tools_find_them() {
        let home = tempfile::tempdir().unwrap();
        std::fs::create_dir(home.path().join(".aws")).unwrap();
        let credentials = "[default]\naws_access_key_id = one\naws_secret_access_key = a/b\\c+d=\n\n\
            [lab]\naws_access_key_id=two\naws_secret_access_key=three\n";
        let config = "[default]\nregion = eu-1\n[profile lab]\nregion = lab-1\nendpoint_url = http://lab:9000\n\
            [profile sso]\nsso_session = university\n";
        std::fs::write(home.path().join(".aws/credentials"), credentials).unwrap();
        std::fs::write(home.path().join(".aws/config"), config).unwrap();
        let read = |set: &[(&str, &str)]| {
            let set: BTreeMap<String, String> =
                set.iter().map(|(name, value)| ((*name).to_string(), (*value).to_string())).collect();
            settings(&|name| match name {
                "HOME" => Some(home.path().to_string_lossy().into_owned()),
                _ => set.get(name).cloned(),
            })
            .map(|found| found.into_iter().map(|(name, value)| format!("{name}={value}")).collect::<Vec<_>>())
            .map_err(|error| error.to_string())
        };
        let default = ["AWS_ACCESS_KEY_ID=one", "AWS_SECRET_ACCESS_KEY=a/b\\c+d=", "AWS_REGION=eu-1"];
        assert_eq!(read(&[]).unwrap(), default);
        let lab = read(&[("AWS_PROFILE", "lab"), ("AWS_REGION", "mine")]).unwrap();
        let expected =
            ["AWS_ACCESS_KEY_ID=two", "AWS_SECRET_ACCESS_KEY=three", "AWS_ENDPOINT_URL=http://lab:9000"];
        assert_eq!(lab, expected);
        // Keys of the environment are never mixed with those of a file.
        assert_eq!(read(&[("AWS_ACCESS_KEY_ID", "own")]).unwrap(), ["AWS_REGION=eu-1"]);
        assert!(read(&[("AWS_PROFILE", "labb")]).unwrap_err().contains("AWS_PROFILE is labb"));
        let sso = read(&[("AWS_PROFILE", "sso")]).unwrap_err();
        assert!(sso.contains("export-credentials") && sso.contains("--profile sso"), "{sso}");
    }
}
