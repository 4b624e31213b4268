//! Who may do what.

use super::{Answer, Server, wait_until, whole};
use crate::{
    cli::{Folder, data, fails, rpfd, stderr},
    wire::interop::{CLIENT, run_python},
};
use std::{io::Write, path::Path, process::Command};

/// Makes tokens with the real command, and gives them; their entries go to one file.
fn tokens(folder: &Folder, wanted: &[(&str, &str)]) -> (String, Vec<String>) {
    let (file, mut entries, mut tokens) = (folder.path("tokens.toml"), String::new(), Vec::new());
    for (name, roles) in wanted {
        let secret = folder.path(&format!("{name}.token"));
        let output = rpfd(["token", name, "--roles", roles, "--secret", &secret]);
        assert!(output.status.success(), "{}", stderr(&output));
        entries += std::str::from_utf8(&output.stdout).unwrap();
        tokens.push(std::fs::read_to_string(&secret).unwrap().trim().to_owned());
    }
    std::fs::write(&file, &entries).unwrap();
    assert!(tokens.iter().all(|token| !entries.contains(token)));
    (file, tokens)
}

fn bearer(token: &str) -> String {
    format!("Authorization: Bearer {token}")
}

#[test]
fn a_token_is_needed_and_its_role() {
    let folder = Folder::new();
    let (file, tokens) = tokens(&folder, &[("farm", "submit"), ("viewer", "read")]);
    let server = Server::start(&["--token-file", &file]);
    let (farm, viewer) = (bearer(&tokens[0]), bearer(&tokens[1]));
    let call = |method: &str, path: &str, authorization: &[&str]| {
        server.call(method, path, authorization, br#"{"width": 8, "height": 8, "id": "x"}"#)
    };
    let refused = call("GET", "/v1/images", &[]);
    refused.problem(401, "missing_token");
    assert_eq!(refused.header("www-authenticate"), Some("Bearer realm=\"rpfd\""));
    let refused = call("POST", "/v1/images", &["Authorization: Bearer 0123456789abcdef0123456789abcdef"]);
    refused.problem(401, "unknown_token");
    assert!(refused.header("www-authenticate").unwrap().contains("invalid_token"));
    call("POST", "/v1/images", &[&viewer]).problem(403, "missing_role");
    assert_eq!(call("POST", "/v1/images", &[&farm]).status, 201);
    call("GET", "/v1/images/x", &[&farm]).problem(403, "missing_role");
    assert_eq!(call("GET", "/v1/images/x", &[&viewer]).status, 200);
    call("DELETE", "/v1/images/x", &[&viewer]).problem(403, "missing_role");
    assert_eq!(call("DELETE", "/v1/images/x", &[&farm]).status, 204);
    // What is nowhere is not told to those without a token.
    call("GET", "/v1/nothing", &[]).problem(401, "missing_token");
    call("GET", "/v1/nothing", &[&viewer]).problem(404, "not_found");
    assert_eq!(server.post("/v1/filter", &whole(16)).status, 401);
    assert_eq!(server.call("PUT", "/v1/filter", &[&farm], &whole(16)).messages().len(), 2);
    for open in ["/livez", "/readyz", "/openapi.json"] {
        assert_eq!(server.get(open).status, 200, "{open}");
    }
}

#[test]
fn tokens_are_read_again_and_a_bad_file_changes_nothing() {
    let folder = Folder::new();
    let (file, first) = tokens(&folder, &[("old", "read")]);
    let log = folder.path("log");
    let server = Server::start_logging(&["--token-file", &file], Some(log.as_ref()));
    let status = |token: &str| server.call("GET", "/v1/images", &[&bearer(token)], &[]).status;
    assert_eq!(status(&first[0]), 200);
    std::fs::write(&file, "[[token]]\nname = 'x'").unwrap();
    server.signal("-HUP");
    wait_until("the file is refused", || std::fs::read_to_string(&log).unwrap().contains("tokens not read again"));
    assert_eq!(status(&first[0]), 200);
    std::fs::remove_file(folder.path("old.token")).unwrap();
    let (_, second) = tokens(&folder, &[("new", "read")]);
    server.signal("-HUP");
    wait_until("the new token is known", || status(&second[0]) == 200);
    assert_eq!(status(&first[0]), 401);
}

#[test]
fn a_bad_file_of_tokens_is_refused_at_the_start() {
    let folder = Folder::new();
    let file = folder.path("tokens.toml");
    std::fs::write(&file, "[[token]]\nname = \"a b\"\ntoken = \"0123456789abcdef0123456789abcdef\"\n").unwrap();
    let output = rpfd(["serve", "--listen", "127.0.0.1:0", "--token-file", &file]);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(2), "{said}");
    for part in ["line 1", "name has 1 to 64", "no key \"token\"", "needs roles", "needs hash", "(bad_tokens)"] {
        assert!(said.contains(part), "{part}: {said}");
    }
    assert!(!said.contains("0123456789abcdef"));
    let missing = folder.path("missing.toml");
    assert_eq!(rpfd(["serve", "--listen", "127.0.0.1:0", "--token-file", &missing]).status.code(), Some(2));
}

#[test]
fn the_client_sends_a_token_from_a_file_or_the_environment() {
    let folder = Folder::new();
    let (file, tokens) = tokens(&folder, &[("farm", "submit,read")]);
    let server = Server::start(&["--token-file", &file]);
    let (url, input) = (format!("http://{}", server.address), data("small.tiles.zst"));
    let out = folder.path("out.exr");
    let post = ["post", input.to_str().unwrap(), "--to", &url, "-o", &out, "--preset", "unfiltered"];
    let (code, _) = fails(4, post);
    assert_eq!(code, "missing_token");
    let secret = folder.path("farm.token");
    let output = rpfd(post.iter().copied().chain(["--token-file", &secret]));
    assert!(output.status.success(), "{}", stderr(&output));
    std::fs::remove_file(&out).unwrap();
    let run =
        |token: &str| Command::new(env!("CARGO_BIN_EXE_rpfd")).args(post).env("RPFD_TOKEN", token).output().unwrap();
    let output = run(&tokens[0]);
    assert!(output.status.success(), "{}", stderr(&output));
    let output = run("short");
    assert!(output.status.code() == Some(2) && stderr(&output).contains("32 to 512"), "{}", stderr(&output));
}

#[test]
fn the_python_client_sends_a_token() {
    let folder = Folder::new();
    let (file, tokens) = tokens(&folder, &[("farm", "submit,read")]);
    let server = Server::start(&["--token-file", &file]);
    let (input, out) = (folder.path("in.tiles"), folder.path("out.npy"));
    std::fs::write(&input, whole(16)).unwrap();
    if run_python("numpy, msgpack", "-c".as_ref(), &["pass".as_ref()]).is_none() {
        return;
    }
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("proto").join(CLIENT);
    let post = |token: Option<&str>| {
        let mut command = Command::new("python3");
        command.arg(&script).args(["post", &format!("http://{}/v1/filter", server.address), &input, &out]);
        command.env("PYTHONDONTWRITEBYTECODE", "1").envs(token.map(|token| ("RPFD_TOKEN", token))).output().unwrap()
    };
    assert!(stderr(&post(None)).contains("missing_token"));
    assert!(post(Some(&tokens[0])).status.success());
}

#[test]
fn images_of_one_token_are_limited() {
    let folder = Folder::new();
    let (file, mut tokens) = tokens(&folder, &[("a", "submit,read"), ("b", "submit,read")]);
    let output = rpfd(["token", "few", "--images", "1", "--secret", &folder.path("few.token")]);
    let entry = String::from_utf8(output.stdout).unwrap();
    assert!(entry.contains("images = 1\n"), "{entry}");
    std::fs::write(&file, std::fs::read_to_string(&file).unwrap() + &entry).unwrap();
    tokens.push(std::fs::read_to_string(folder.path("few.token")).unwrap().trim().to_owned());
    let arguments = ["--token-file", &file, "--token-images", "2", "--images", "4"];
    let mut server = Server::start(&arguments);
    let open = |server: &Server, token: usize, id: &str| {
        let body = format!(r#"{{"width": 8, "height": 8, "id": "{id}"}}"#);
        server.call("POST", "/v1/images", &[&bearer(&tokens[token])], body.as_bytes())
    };
    assert_eq!((open(&server, 0, "a1").status, open(&server, 0, "a2").status), (201, 201));
    for _ in 0..2 {
        let refused = open(&server, 0, "a3");
        let problem = refused.problem(429, "image_quota");
        assert!(problem["detail"].as_str().unwrap().contains("2 images"), "{problem}");
        assert_eq!(refused.header("retry-after"), Some("60"));
        // What is open already is; whoever opened it.
        assert_eq!((open(&server, 0, "a1").status, open(&server, 1, "a1").status), (200, 200));
        // Whose they are is known after a new start.
        server = Server::start_in(server.kill(), &arguments);
    }
    assert_eq!(open(&server, 2, "few1").status, 201);
    open(&server, 2, "few2").problem(429, "image_quota");
    // Others have room, until all of it is taken; one's own is free again after an image.
    assert_eq!(open(&server, 1, "b1").status, 201);
    open(&server, 1, "b2").problem(503, "too_many_images");
    let delete = server.call("DELETE", "/v1/images/a2", &[&bearer(&tokens[1])], &[]);
    assert_eq!((delete.status, open(&server, 0, "a3").status), (204, 201));
}

#[test]
fn requests_at_once_are_limited() {
    let folder = Folder::new();
    let (file, tokens) = tokens(&folder, &[("a", "submit"), ("b", "submit,read")]);
    let limited = std::fs::read_to_string(&file).unwrap().replacen("roles", "requests = 1\nroles", 1);
    std::fs::write(&file, limited).unwrap();
    let server = Server::start(&["--token-file", &file, "--requests", "2"]);
    let body = whole(16);
    let begin = |token: &str| server.begin("/v1/filter", &[&bearer(token)], &body[..body.len() / 2], body.len());
    let status = |token: &str| server.call("POST", "/v1/filter", &[&bearer(token)], b"").status;
    let mut first = begin(&tokens[0]);
    assert_eq!(status(&tokens[0]), 429);
    let answer = server.call("POST", "/v1/filter", &[&bearer(&tokens[0])], b"");
    assert!(answer.problem(429, "too_many_requests")["detail"].as_str().unwrap().contains("with this token"));
    assert_eq!(answer.header("retry-after"), Some("1"));
    // Others have room, until all of it is taken.
    let _second = begin(&tokens[1]);
    assert_eq!(status(&tokens[1]), 429);
    assert_eq!(server.get("/readyz").status, 200);
    first.write_all(&body[body.len() / 2..]).unwrap();
    assert_eq!(Answer::read(&mut first).messages().len(), 2);
    wait_until("there is room again", || status(&tokens[0]) == 400);
}
