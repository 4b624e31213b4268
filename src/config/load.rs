//! Where a [`Config`] comes from: flags, before environment variables, before a TOML file, before the defaults.
//!
//! All that is wrong in any of them is told at once, each fault with the place that it is from.

use std::{
    collections::BTreeMap,
    fmt,
    path::{Path, PathBuf},
};

use toml::de::{DeTable, DeValue};

use super::{Config, ConfigError, SETTINGS, Setting};

/// What all environment variables of ours begin with.
const PREFIX: &str = "RPFD_";
/// Variables with this beginning that are no settings of the service: the file itself, the client's token, the tests'.
const OTHERS: [&str; 12] = [
    "RPFD_CONFIG",
    "RPFD_TOKEN",
    "RPFD_DATA",
    "RPFD_CI",
    "RPFD_REGENERATE",
    "RPFD_LOAD",
    "RPFD_FUZZ",
    "RPFD_FUZZ_SEED",
    "RPFD_WORKLOAD",
    "RPFD_FAULTS",
    "RPFD_SEED",
    "RPFD_SIDE",
];
/// Most bytes of a configuration file.
const MAX_FILE: u64 = 1 << 20;

/// Where a value is from.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Source {
    /// A line of the file, from 1.
    File(PathBuf, usize),
    /// An environment variable.
    Environment(String),
    /// A flag.
    Flag(String),
}

impl fmt::Display for Source {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File(path, line) => write!(f, "{}, line {line}", path.display()),
            Self::Environment(name) => write!(f, "environment {name}"),
            Self::Flag(name) => write!(f, "flag {name}"),
        }
    }
}

/// A configuration, and where each of its values is from.
#[derive(Clone, Debug)]
pub struct Loaded {
    /// The configuration, checked.
    pub config: Config,
    sources: BTreeMap<&'static str, Source>,
}

/// The flag of a setting: `--queue-deadline`.
pub(crate) fn flag(name: &str) -> String {
    format!("--{}", name.replace('_', "-"))
}

/// The environment variable of a setting: `RPFD_QUEUE_DEADLINE`.
pub(crate) fn variable(name: &str) -> String {
    format!("{PREFIX}{}", name.to_ascii_uppercase())
}

/// Reads a configuration. `flags` are names of settings with their values in words, `environment` is all of it, `file`
/// the TOML file if there is one.
pub fn load(
    flags: impl IntoIterator<Item = (String, String)>,
    environment: impl IntoIterator<Item = (String, String)>,
    file: Option<&Path>,
) -> Result<Loaded, ConfigError> {
    let mut given = Given { values: Vec::new(), wrong: Vec::new() };
    if let Some(path) = file {
        given.read_file(path);
    }
    for (name, value) in environment {
        given.read_variable(&name, value);
    }
    for (name, value) in flags {
        let source = Source::Flag(flag(&name));
        given.take(&name, value, source);
    }
    given.finish()
}

/// What was given, the weakest source first.
struct Given {
    values: Vec<(&'static Setting, String, Source)>,
    wrong: Vec<String>,
}

impl Given {
    fn take(&mut self, name: &str, value: String, source: Source) {
        match SETTINGS.iter().find(|setting| setting.name == name) {
            Some(setting) => self.values.push((setting, value, source)),
            None => self.wrong.push(format!("{source}: there is no setting {name:?}{}", nearest(name))),
        }
    }

    fn read_variable(&mut self, name: &str, value: String) {
        let Some(key) = name.strip_prefix(PREFIX) else { return };
        let source = Source::Environment(name.to_owned());
        let key = key.to_ascii_lowercase();
        let known = SETTINGS.iter().any(|setting| setting.name == key);
        if known || !(OTHERS.contains(&name) || of_kubernetes(name)) {
            self.take(&key, value, source);
        }
    }

    fn read_file(&mut self, path: &Path) {
        let text = match read(path) {
            Ok(text) => text,
            Err(error) => return self.wrong.push(format!("{}: cannot be read: {error}", path.display())),
        };
        let line = |at: usize| text.as_bytes()[..at.min(text.len())].iter().filter(|&&b| b == b'\n').count() + 1;
        let (table, errors) = DeTable::parse_recoverable(&text);
        for error in &errors {
            let source = Source::File(path.to_owned(), line(error.span().map_or(0, |span| span.start)));
            self.wrong.push(format!("{source}: {}", error.message().replace('\n', ", ")));
        }
        for (key, value) in table.get_ref() {
            let source = Source::File(path.to_owned(), line(key.span().start));
            match plain(value.get_ref()) {
                Some(words) => self.take(key.get_ref(), words, source),
                // What comes behind a syntax error may be read as anything.
                None if !errors.is_empty() => {}
                None => {
                    let kind = value.get_ref().type_str();
                    self.wrong.push(format!(
                        "{source}: {}: must be a text, a number, true or false, not a {kind}",
                        key.get_ref()
                    ));
                }
            }
        }
    }

    fn finish(self) -> Result<Loaded, ConfigError> {
        let Self { values, mut wrong } = self;
        let (mut config, mut sources) = (Config::default(), BTreeMap::new());
        for (setting, value, source) in values {
            match (setting.read)(&mut config, &value) {
                Ok(()) => _ = sources.insert(setting.name, source),
                Err(error) => wrong.push(format!("{source}: {}: {error}", setting.name)),
            }
        }
        wrong.extend(config.faults(|setting| match sources.get(setting.name) {
            Some(source) => format!("{source}: {}", setting.name),
            None => setting.name.to_owned(),
        }));
        if wrong.is_empty() { Ok(Loaded { config, sources }) } else { Err(ConfigError(wrong)) }
    }
}

fn read(path: &Path) -> std::io::Result<String> {
    use std::io::Read;
    let mut text = String::new();
    std::fs::File::open(path)?.take(MAX_FILE + 1).read_to_string(&mut text)?;
    if text.len() as u64 > MAX_FILE {
        return Err(std::io::Error::other("it is larger than 1 MiB"));
    }
    Ok(text)
}

/// A value in words.
fn plain(value: &DeValue) -> Option<String> {
    match value {
        DeValue::String(text) => Some(text.clone().into_owned()),
        DeValue::Boolean(on) => Some(on.to_string()),
        DeValue::Integer(number) => i128::from_str_radix(number.as_str(), number.radix()).ok().map(|n| n.to_string()),
        DeValue::Float(number) => Some(number.as_str().to_owned()),
        _ => None,
    }
}

/// Whether Kubernetes makes variables of such a name, for a Service whose name starts with `rpfd`.
fn of_kubernetes(name: &str) -> bool {
    ["_SERVICE_HOST", "_PORT"].iter().any(|end| name.ends_with(end))
        || name.contains("_SERVICE_PORT")
        || name.contains("_PORT_")
}

/// The setting that was meant, if one is near.
fn nearest(name: &str) -> String {
    let near = |setting: &&Setting| strsim::jaro_winkler(&name.replace('-', "_"), setting.name);
    let best = SETTINGS.iter().max_by(|a, b| near(a).total_cmp(&near(b))).filter(|best| near(best) > 0.8);
    best.map_or_else(String::new, |best| format!(": {} is meant?", best.name))
}

impl Loaded {
    /// The configuration as TOML that [`load`] reads again, with what each setting is, its default and its source.
    pub fn to_toml(&self) -> String {
        let default = Config::default();
        let mut out = String::from(
            "# The effective configuration of rpfd serve. Flags take the place of environment variables, these of the file.\n",
        );
        for setting in SETTINGS {
            let value = |config| (setting.to_toml)(config);
            let help = setting.help.iter().map(|line| line.trim()).collect::<Vec<_>>().join(" ");
            let (flag, variable) = (flag(setting.name), variable(setting.name));
            let from = self.sources.get(setting.name).map_or_else(String::new, |source| format!("; set by {source}"));
            out += &format!("\n# {}\n", help.replace('\n', " "));
            out += &format!(
                "# default {}; {flag}, {variable}{}\n",
                value(&default).as_deref().unwrap_or("not set"),
                one_line(&from)
            );
            out += &match value(&self.config) {
                Some(value) => format!("{} = {value}\n", setting.name),
                None => format!("# {} = \"{}\"\n", setting.name, setting.value),
            };
        }
        out
    }
}

/// Without what would end a comment.
fn one_line(text: &str) -> String {
    text.replace(char::is_control, " ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    fn pairs(pairs: &[(&str, &str)]) -> Vec<(String, String)> {
        pairs.iter().map(|(name, value)| ((*name).to_owned(), (*value).to_owned())).collect()
    }

    fn file(text: &str) -> tempfile::NamedTempFile {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        file
    }

    #[test]
    fn flags_win_over_environment_over_file_over_defaults() {
        let file = file(
            "memory = \"2GiB\"\nthreads = 3\nimages = 0x10\nidle_deadline = 1.5\nlog = 'warn'\ninsecure_no_auth = true\n",
        );
        let environment =
            pairs(&[("RPFD_THREADS", "4"), ("RPFD_IMAGES", "5"), ("HOME", "/"), ("RPFD_TOKEN", "secret")]);
        let loaded = load(pairs(&[("images", "6")]), environment, Some(file.path())).unwrap();
        let config = &loaded.config;
        assert_eq!((config.memory.0, config.threads, config.images), (2 << 30, 4, 6));
        assert_eq!((config.idle_deadline, config.log.as_str()), (Duration::from_millis(1500), "warn"));
        assert_eq!((config.insecure_no_auth, config.connections), (true, Config::default().connections));
        let text = loaded.to_toml();
        for said in
            ["set by flag --images", "set by environment RPFD_THREADS", ", line 1\nmemory = \"2GiB\"", "default 1024"]
        {
            assert!(text.contains(said), "{said}: {text}");
        }
        assert!(!text.contains("secret"));
    }

    #[test]
    fn what_is_printed_is_read_again() {
        let given = pairs(&[
            ("listen", "[::1]:9"),
            ("metrics_listen", "127.0.0.1:0"),
            ("token_file", "/a \"b\"\\\n/ü"),
            ("memory", "1073741825"),
            ("queue_deadline", "0.0000012"),
            ("log_format", "json"),
        ]);
        let loaded = load(given, [], None).unwrap();
        let printed = file(&loaded.to_toml());
        let again = load([], [], Some(printed.path())).unwrap();
        assert_eq!(again.config, loaded.config);
        let defaults = file(&load([], [], None).unwrap().to_toml());
        assert_eq!(load([], [], Some(defaults.path())).unwrap().config, Config::default());
    }

    #[test]
    fn all_that_is_wrong_is_told_with_its_place() {
        let file = file("memroy = \"2GiB\"\nthreads = \"many\"\n\nimages = [1]\n[listen]\nport = 3\n");
        let environment =
            pairs(&[("RPFD_IMAGE_PIXEL", "5"), ("RPFD_CONNECTIONS", "0"), ("RPFD_PORT", "tcp://10.0.0.1:80")]);
        let flags = pairs(&[("queue_deadline", "soon"), ("threads", "0")]);
        let wrong = load(flags, environment, Some(file.path())).unwrap_err().0;
        let path = file.path().display();
        for (i, said) in [
            format!("{path}, line 4: images: must be a text, a number, true or false, not a array"),
            format!("{path}, line 5: listen: must be"),
            format!("{path}, line 1: there is no setting \"memroy\": memory is meant?"),
            "environment RPFD_IMAGE_PIXEL: there is no setting \"image_pixel\": image_pixels is meant?".to_owned(),
            format!("{path}, line 2: threads: \"many\": must be a whole number"),
            "flag --queue-deadline: queue_deadline: \"soon\" is no time".to_owned(),
            "flag --threads: threads = 0: must be 1 to 1024".to_owned(),
            "environment RPFD_CONNECTIONS: connections = 0: must be 1 to 65536".to_owned(),
        ]
        .iter()
        .enumerate()
        {
            assert!(wrong.iter().any(|line| line.starts_with(said.as_str())), "{i}: {said}\n{wrong:#?}");
        }
        assert_eq!(wrong.len(), 8, "{wrong:#?}");
    }

    #[test]
    fn a_file_that_is_no_toml_is_refused() {
        let twice = file("images = 1\nimages = 2\nlisten = \n");
        let wrong = load([], [], Some(twice.path())).unwrap_err().0;
        assert!(
            wrong.iter().any(|line| line.contains("line 2")) && wrong.iter().any(|line| line.contains("line 3")),
            "{wrong:?}"
        );
        assert!(load([], [], Some(Path::new("/nowhere/at all"))).unwrap_err().0[0].contains("/nowhere/at all"));
        let huge = file(&"#".repeat((1 << 20) + 1));
        assert!(load([], [], Some(huge.path())).unwrap_err().0[0].contains("1 MiB"));
    }

    #[test]
    fn names_are_one_to_one() {
        for setting in SETTINGS {
            assert!(!OTHERS.contains(&variable(setting.name).as_str()), "{setting:?}");
            assert!(setting.help.iter().all(|line| line.len() < 120));
        }
    }
}
