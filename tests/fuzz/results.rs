//! Result streams, as a client reads them.

use super::{alone, fuzz, mutate::Random, mutate::mutate, vectors};
use rpfd::wire::ResultDecoder;

/// The messages in words, and the error.
fn read(bytes: &[u8], piece: usize) -> (usize, String) {
    let (mut decoder, mut said, mut messages) = (ResultDecoder::new(), String::new(), 0);
    for mut chunk in bytes.chunks(piece) {
        loop {
            match decoder.next(&mut chunk) {
                Ok(None) => break,
                Ok(Some(message)) => {
                    messages += 1;
                    said += &format!("{message:?}\n");
                }
                Err(error) => {
                    assert_eq!(decoder.finish(), Err(error.clone()));
                    return (messages, said + &error.to_string());
                }
            }
        }
    }
    let end = decoder.finish().map_or_else(|error| error.to_string(), |()| "end".to_owned());
    (messages, said + &end)
}

#[test]
fn result_streams() {
    let alone = alone();
    let examples = vectors();
    let results: Vec<_> = super::files("proto/vectors", "result").into_iter().map(|file| file.1).collect();
    let words: &[&[u8]] =
        &[b"\xa6result", b"\xa5error", b"\xa3end", b"\xa6report", b"\xa7problem", b"\xa4tile", b"\xdf\xff\xff\xff\xff"];
    let make = |random: &mut Random| {
        let mut bytes = random.pick(&results).clone();
        mutate(&mut bytes, random, &examples, words);
        bytes
    };
    let reached = fuzz(&alone, "results", 10, make, |bytes, random| {
        let whole = read(bytes, usize::MAX);
        assert_eq!(read(bytes, 1 + random.below(20)), whole);
        ["no message", "a message", "several messages"][whole.0.min(2)]
    });
    assert!(reached.len() == 3, "{reached:?}");
}
