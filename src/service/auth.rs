//! Who may do what: bearer tokens from a file, how many requests each may have under way, and how many images open.
//!
//! The file holds BLAKE3 hashes: whoever reads it cannot use the service. A token of [`MIN_TOKEN`] random characters
//! cannot be guessed, so that its hash needs neither salt nor slowness.

use std::{
    path::{Path, PathBuf},
    sync::{
        Arc, PoisonError, RwLock,
        atomic::{AtomicUsize, Ordering},
    },
};

use axum::{
    extract::{Request, State},
    http::{HeaderMap, Method, StatusCode, header},
    middleware::Next,
    response::Response,
};
use toml::de::{DeTable, DeValue};

use super::{Shared, problem::Refusal};
use crate::{
    config::{Config, MAX_COUNT},
    wire::Problem,
};

/// Fewest characters of a token.
pub const MIN_TOKEN: usize = 32;
/// Most characters of a token.
pub const MAX_TOKEN: usize = 512;
/// Most tokens of a file.
const MAX_TOKENS: usize = 1024;
/// Most bytes of the file.
const MAX_FILE: u64 = 1 << 20;
/// Paths that need no token.
const OPEN: [&str; 3] = ["/livez", "/readyz", "/openapi.json"];

/// What a token allows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// Sending tiles, opening and deleting images.
    Submit,
    /// Looking at images and fetching them.
    Read,
}

impl Role {
    /// The names of all roles.
    pub const NAMES: [(&'static str, Self); 2] = [("submit", Self::Submit), ("read", Self::Read)];

    fn of(method: &Method) -> Self {
        if *method == Method::GET || *method == Method::HEAD { Self::Read } else { Self::Submit }
    }

    fn name(self) -> &'static str {
        Self::NAMES.iter().find(|(_, role)| *role == self).map_or("", |(name, _)| name)
    }
}

/// All that is wrong with a file of tokens, one line each.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{}", .0.join("\n"))]
pub struct TokensError(pub Vec<String>);

/// One who may use the service.
#[derive(Debug)]
struct Token {
    name: Arc<str>,
    hash: blake3::Hash,
    roles: Vec<Role>,
    /// Requests that it may have under way; none: as many as the configuration says.
    limit: Option<usize>,
    /// Images that it may have open; none: as many as the configuration says.
    images: Option<usize>,
    in_flight: Arc<AtomicUsize>,
}

/// Whose a request is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Owner {
    /// The token's name.
    pub(super) name: Arc<str>,
    /// Images that it may have open.
    pub(super) images: usize,
}

/// Checks a token, and says what would be right.
pub fn check_token(token: &str) -> Result<(), String> {
    let fine = |b: u8| b.is_ascii_alphanumeric() || b"-._~+/=".contains(&b);
    if (MIN_TOKEN..=MAX_TOKEN).contains(&token.len()) && token.bytes().all(fine) {
        return Ok(());
    }
    Err(format!("a token has {MIN_TOKEN} to {MAX_TOKEN} characters of A-Z a-z 0-9 - . _ ~ + / ="))
}

/// What the file holds of a token.
pub fn hash_token(token: &str) -> String {
    blake3::hash(token.as_bytes()).to_hex().to_string()
}

/// Checks the name of a token, and says what would be right.
pub fn check_name(name: &str) -> Result<(), String> {
    let fine = |b: u8| b.is_ascii_alphanumeric() || b"._-".contains(&b);
    if (1..=64).contains(&name.len()) && name.bytes().all(fine) {
        return Ok(());
    }
    Err("a token's name has 1 to 64 characters of A-Z a-z 0-9 . _ -".to_owned())
}

/// Reads a file of tokens.
fn read(path: &Path) -> Result<Vec<Token>, TokensError> {
    use std::io::Read;
    let wrong = |what: String| TokensError(vec![format!("{}: {what}", path.display())]);
    let mut text = String::new();
    let file = std::fs::File::open(path).and_then(|file| file.take(MAX_FILE + 1).read_to_string(&mut text));
    file.map_err(|error| wrong(format!("cannot be read: {error}")))?;
    if text.len() as u64 > MAX_FILE {
        return Err(wrong("it is larger than 1 MiB".to_owned()));
    }
    parse(&text).map_err(|all| {
        TokensError(all.into_iter().map(|(line, what)| format!("{}, line {line}: {what}", path.display())).collect())
    })
}

/// The tokens, or all that is wrong by line.
fn parse(text: &str) -> Result<Vec<Token>, Vec<(usize, String)>> {
    let line = |at: usize| text.as_bytes()[..at.min(text.len())].iter().filter(|&&b| b == b'\n').count() + 1;
    let (table, errors) = DeTable::parse_recoverable(text);
    let mut wrong: Vec<_> =
        errors.iter().map(|e| (line(e.span().map_or(0, |span| span.start)), e.message().replace('\n', ", "))).collect();
    if !wrong.is_empty() {
        return Err(wrong);
    }
    let mut tokens: Vec<Token> = Vec::new();
    for (key, value) in table.get_ref() {
        let at = line(key.span().start);
        let Some(entries) = value.get_ref().as_array().filter(|_| key.get_ref() == "token") else {
            wrong.push((at, format!("there is nothing but [[token]], not {:?}", key.get_ref())));
            continue;
        };
        for entry in entries.iter() {
            let at = line(entry.span().start);
            match entry.get_ref().as_table().map(one) {
                None => wrong.push((at, "must be a [[token]]".to_owned())),
                Some(Err(all)) => wrong.extend(all.into_iter().map(|what| (at, what))),
                Some(Ok(token)) if tokens.iter().any(|t| t.name == token.name) => {
                    wrong.push((at, format!("there are two tokens named {:?}", token.name)));
                }
                Some(Ok(token)) if tokens.iter().any(|t| t.hash == token.hash) => {
                    wrong.push((at, format!("the hash of {:?} is another token's too", token.name)));
                }
                Some(Ok(token)) => tokens.push(token),
            }
        }
    }
    if wrong.is_empty() && tokens.is_empty() {
        wrong.push((1, "there is no [[token]] in it: nobody could use the service".to_owned()));
    }
    if tokens.len() > MAX_TOKENS {
        wrong.push((1, format!("there are more than {MAX_TOKENS} tokens")));
    }
    if wrong.is_empty() { Ok(tokens) } else { Err(wrong) }
}

/// One entry.
fn one(entry: &DeTable) -> Result<Token, Vec<String>> {
    let (mut name, mut hash, mut roles, mut limit, mut images, mut wrong) = (None, None, None, None, None, Vec::new());
    for (key, value) in entry {
        let value = value.get_ref();
        let mut set = |result: Result<(), String>| wrong.extend(result.err());
        match key.get_ref().as_ref() {
            "name" => set(text(value).and_then(|text| {
                check_name(text)?;
                name = Some(Arc::from(text));
                Ok(())
            })),
            "hash" => set(text(value).and_then(|text| {
                let read = blake3::Hash::from_hex(text);
                hash = Some(read.map_err(|_| "hash must be the 64 hex digits that rpfd token prints".to_owned())?);
                Ok(())
            })),
            "roles" => set(read_roles(value).map(|read| roles = Some(read))),
            key @ ("requests" | "images") => {
                let read = value.as_integer().and_then(|n| usize::from_str_radix(n.as_str(), n.radix()).ok());
                let read = read.filter(|n| (1..=MAX_COUNT).contains(n));
                *(if key == "images" { &mut images } else { &mut limit }) = read;
                set(read.map(drop).ok_or_else(|| format!("{key} must be 1 to {MAX_COUNT}")));
            }
            // Never the value: it may be the token itself.
            other => set(Err(format!("there is no key {other:?}: known are name, roles, hash, requests, images"))),
        }
    }
    let missing = [("name", name.is_none()), ("hash", hash.is_none()), ("roles", roles.is_none())];
    match (name, hash, roles) {
        (Some(name), Some(hash), Some(roles)) if wrong.is_empty() => {
            Ok(Token { name, hash, roles, limit, images, in_flight: Arc::default() })
        }
        _ => {
            let given = |key: &str| entry.keys().any(|k| k.get_ref() == key);
            wrong.extend(
                missing
                    .iter()
                    .filter(|(key, none)| *none && !given(key))
                    .map(|(key, _)| format!("a token needs {key}")),
            );
            Err(wrong)
        }
    }
}

fn text<'a>(value: &'a DeValue) -> Result<&'a str, String> {
    value.as_str().ok_or_else(|| format!("must be a text, not a {}", value.type_str()))
}

fn read_roles(value: &DeValue) -> Result<Vec<Role>, String> {
    let known = "roles must be a list of \"submit\" and \"read\"";
    let roles = value.as_array().ok_or(known)?.iter().map(|role| {
        let name = role.get_ref().as_str()?;
        Role::NAMES.iter().find(|(known, _)| *known == name).map(|(_, role)| *role)
    });
    roles.collect::<Option<Vec<_>>>().filter(|roles| !roles.is_empty()).ok_or_else(|| known.to_owned())
}

/// The tokens that are valid now, and the requests under way.
#[derive(Debug)]
pub(super) struct Auth {
    path: Option<PathBuf>,
    tokens: RwLock<Vec<Token>>,
    in_flight: Arc<AtomicUsize>,
    limit: usize,
    token_limit: usize,
    token_images: usize,
}

/// A request that may go on; dropping it makes room for another.
#[derive(Debug)]
pub(super) struct Pass {
    counters: Vec<Arc<AtomicUsize>>,
}

impl Pass {
    fn enter(&mut self, counter: &Arc<AtomicUsize>, limit: usize, whose: &str) -> Result<(), Refusal> {
        if counter.fetch_add(1, Ordering::Relaxed) >= limit {
            counter.fetch_sub(1, Ordering::Relaxed);
            let detail =
                format!("{limit} requests {whose} are under way already, as many as may be: wait for one to end");
            return Err(Problem::new(429, "too_many_requests", "Too many requests at once", detail)
                .with("retry_after", 1)
                .into());
        }
        self.counters.push(Arc::clone(counter));
        Ok(())
    }
}

impl Drop for Pass {
    fn drop(&mut self) {
        for counter in &self.counters {
            counter.fetch_sub(1, Ordering::Relaxed);
        }
    }
}

impl Auth {
    /// Reads the tokens, if there is a file of them.
    pub(super) fn new(config: &Config) -> Result<Self, TokensError> {
        let path = config.token_file.clone();
        let tokens = RwLock::new(path.as_deref().map(read).transpose()?.unwrap_or_default());
        let (limit, token_limit, token_images) = (config.requests, config.token_requests, config.token_images);
        Ok(Self { path, tokens, in_flight: Arc::default(), limit, token_limit, token_images })
    }

    /// Reads the file again; requests that were let in go on. If it is wrong all stays as it was. Blocks.
    pub(super) fn reload(&self) -> Result<usize, TokensError> {
        let Some(path) = &self.path else { return Ok(0) };
        let mut new = read(path)?;
        let mut tokens = self.tokens.write().unwrap_or_else(PoisonError::into_inner);
        for token in &mut new {
            if let Some(old) = tokens.iter().find(|old| old.hash == token.hash) {
                token.in_flight = Arc::clone(&old.in_flight);
            }
        }
        *tokens = new;
        Ok(tokens.len())
    }

    /// Lets a request in, or says why not; and whose it is.
    fn check(&self, method: &Method, path: &str, headers: &HeaderMap) -> Result<(Pass, Option<Owner>), Refusal> {
        let mut pass = Pass { counters: Vec::with_capacity(2) };
        if OPEN.contains(&path) {
            return Ok((pass, None));
        }
        let mut whose = None;
        if self.path.is_some() {
            let given = bearer(headers)?;
            let tokens = self.tokens.read().unwrap_or_else(PoisonError::into_inner);
            // Hashes are compared in constant time, and all of them.
            let hash = blake3::hash(given.as_bytes());
            let found = tokens.iter().fold(None, |found, token| if token.hash == hash { Some(token) } else { found });
            let Some(token) = found else {
                return Err(Refusal::new(
                    StatusCode::UNAUTHORIZED,
                    "unknown_token",
                    "The token is not known",
                    "the bearer token is none of those that are valid",
                ));
            };
            tracing::Span::current().record("token", &*token.name);
            let role = Role::of(method);
            if !token.roles.contains(&role) {
                let detail = format!(
                    "{method} needs the role {:?}, which the token {:?} does not have",
                    role.name(),
                    token.name
                );
                return Err(Refusal::new(
                    StatusCode::FORBIDDEN,
                    "missing_role",
                    "The token does not allow this",
                    detail,
                ));
            }
            pass.enter(&token.in_flight, token.limit.unwrap_or(self.token_limit), "with this token")?;
            whose = Some(Owner { name: Arc::clone(&token.name), images: token.images.unwrap_or(self.token_images) });
        }
        pass.enter(&self.in_flight, self.limit, "in all")?;
        Ok((pass, whose))
    }
}

/// The token that a request brings.
fn bearer(headers: &HeaderMap) -> Result<&str, Refusal> {
    let refuse =
        |detail: &str| Err(Refusal::new(StatusCode::UNAUTHORIZED, "missing_token", "A token is needed", detail));
    let mut given = headers.get_all(header::AUTHORIZATION).into_iter();
    match (given.next(), given.next()) {
        (Some(value), None) => match value.to_str().ok().and_then(|value| value.split_once(' ')) {
            Some((scheme, token)) if scheme.eq_ignore_ascii_case("bearer") => Ok(token.trim()),
            _ => refuse("the header Authorization must be: Bearer TOKEN"),
        },
        (Some(_), Some(_)) => refuse("there is more than one header Authorization"),
        _ => refuse("send the header Authorization: Bearer TOKEN"),
    }
}

/// Lets requests in; the pass goes along with the answer until all of it is sent.
pub(super) async fn admit(
    State(service): State<Shared>,
    mut request: Request,
    next: Next,
) -> Result<Response, Refusal> {
    let (pass, whose) = service.auth.check(request.method(), request.uri().path(), request.headers())?;
    if let Some(owner) = whose {
        request.extensions_mut().insert(owner);
    }
    let mut response = next.run(request).await;
    response.extensions_mut().insert(Arc::new(pass));
    Ok(response)
}

#[cfg(test)]
mod tests {
    use super::*;

    const TOKEN: &str = "0123456789abcdef0123456789abcdef";

    fn auth(text: &str) -> Auth {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        Auth::new(&Config { token_file: Some(file.path().into()), requests: 3, token_requests: 2, ..Config::default() })
            .unwrap()
    }

    fn headers(authorization: &[&str]) -> HeaderMap {
        authorization.iter().map(|value| (header::AUTHORIZATION, value.parse().unwrap())).collect()
    }

    fn entry(name: &str, token: &str, more: &str) -> String {
        format!("[[token]]\nname = {name:?}\nhash = {:?}\n{more}\n", hash_token(token))
    }

    #[test]
    fn tokens_let_in_by_role() {
        let other = TOKEN.replace('0', "x");
        let auth =
            auth(&(entry("a", TOKEN, "roles = [\"read\"]") + &entry("b", &other, "roles = [\"submit\", \"read\"]")));
        let ask = |method: Method, path: &str, authorization: &[&str]| match auth.check(
            &method,
            path,
            &headers(authorization),
        ) {
            Ok((_, whose)) => whose.map_or("open".to_owned(), |owner| owner.name.to_string()),
            Err(refusal) => refusal.0.code,
        };
        let (a, b) = (format!("Bearer {TOKEN}"), format!("bearer  {other}"));
        assert_eq!(ask(Method::GET, "/v1/images", &[&a]), "a");
        assert_eq!(ask(Method::POST, "/v1/images", &[&a]), "missing_role");
        assert_eq!(ask(Method::POST, "/v1/images", &[&b]), "b");
        assert_eq!(ask(Method::DELETE, "/v1/images/x", &[&a]), "missing_role");
        assert_eq!(ask(Method::HEAD, "/v1/images/x", &[&a]), "a");
        assert_eq!(ask(Method::GET, "/livez", &[]), "open");
        assert_eq!(ask(Method::GET, "/v1/images", &[]), "missing_token");
        assert_eq!(ask(Method::GET, "/v1/images", &["Basic eDp5"]), "missing_token");
        assert_eq!(ask(Method::GET, "/v1/images", &[&a, &a]), "missing_token");
        assert_eq!(ask(Method::GET, "/v1/images", &["Bearer"]), "missing_token");
        assert_eq!(ask(Method::GET, "/v1/images", &[&a[..a.len() - 1]]), "unknown_token");
        assert_eq!(ask(Method::GET, "/v1/images", &[&format!("{a}0")]), "unknown_token");
    }

    #[test]
    fn requests_are_counted_for_each_and_for_all() {
        let other = TOKEN.replace('0', "x");
        let auth =
            auth(&(entry("a", TOKEN, "roles = [\"read\"]") + &entry("b", &other, "roles = [\"read\"]\nrequests = 9")));
        let ask = |token: &str| auth.check(&Method::GET, "/v1/images", &headers(&[&format!("Bearer {token}")]));
        let first = ask(TOKEN).unwrap();
        let _second = ask(TOKEN).unwrap();
        let refused = ask(TOKEN).unwrap_err();
        assert!(refused.0.status == 429 && refused.0.detail.contains("2 requests with this token"), "{refused:?}");
        let _third = ask(&other).unwrap();
        assert!(ask(&other).unwrap_err().0.detail.contains("3 requests in all"));
        drop(first);
        assert!(ask(&other).is_ok());
    }

    #[test]
    fn a_bad_file_says_all_that_is_wrong_and_no_secret() {
        let text = format!(
            "{}{}[[token]]\nname = \"a b\"\nroles = [\"write\"]\nhash = \"{TOKEN}\"\ntoken = \"{TOKEN}\"\nrequests = 0\nimages = 65537\n[[token]]\n\n[other]\n",
            entry("a", TOKEN, "roles = [\"read\"]"),
            entry("a", TOKEN, "roles = [\"read\"]"),
        );
        let wrong = parse(&text).unwrap_err();
        let has = |line: usize, said: &str| wrong.iter().any(|(at, what)| *at == line && what.contains(said));
        assert!(has(5, "two tokens") && has(9, "1 to 64") && has(9, "submit") && has(9, "64 hex"), "{wrong:?}");
        assert!(
            has(9, "\"token\"") && has(9, "requests must") && has(16, "needs name") && has(16, "needs hash"),
            "{wrong:?}"
        );
        assert!(has(9, "images must") && has(18, "[[token]]") && wrong.len() == 11, "{wrong:?}");
        assert!(!format!("{wrong:?}").contains(TOKEN));
        assert!(parse("").unwrap_err()[0].1.contains("no [[token]]"));
        assert_eq!(parse("x = \ny = \n").unwrap_err().len(), 2);
    }

    #[test]
    fn a_reload_keeps_what_is_under_way_and_a_bad_one_keeps_all() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let write = |text: &str| std::fs::write(file.path(), text).unwrap();
        write(&entry("a", TOKEN, "roles = [\"read\"]\nrequests = 1"));
        let auth = Auth::new(&Config { token_file: Some(file.path().into()), ..Config::default() }).unwrap();
        let ask =
            || auth.check(&Method::GET, "/v1/images", &headers(&[&format!("Bearer {TOKEN}")])).map_err(|r| r.0.code);
        let held = ask().unwrap();
        write("nonsense");
        assert!(auth.reload().is_err());
        assert_eq!(ask().unwrap_err(), "too_many_requests");
        write(&entry("renamed", TOKEN, "roles = [\"read\"]\nrequests = 1"));
        assert_eq!(auth.reload(), Ok(1));
        assert_eq!(ask().unwrap_err(), "too_many_requests");
        drop(held);
        let images = Config::default().token_images;
        assert_eq!(ask().unwrap().1, Some(Owner { name: "renamed".into(), images }));
        write(&entry("renamed", TOKEN, "roles = [\"read\"]\nimages = 3"));
        assert_eq!((auth.reload(), ask().unwrap().1.map(|owner| owner.images)), (Ok(1), Some(3)));
        write(&entry("b", &TOKEN.replace('0', "x"), "roles = [\"read\"]"));
        assert_eq!(auth.reload(), Ok(1));
        assert_eq!(ask().unwrap_err(), "unknown_token");
    }

    #[test]
    fn tokens_are_long_enough() {
        assert!(check_token(TOKEN).is_ok() && check_token(&"x".repeat(MAX_TOKEN)).is_ok());
        assert!(check_token(&TOKEN[1..]).is_err() && check_token(&"x".repeat(MAX_TOKEN + 1)).is_err());
        assert!(check_token(&format!("{TOKEN} x")).is_err());
    }
}
