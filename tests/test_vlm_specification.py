"""Models in one line, their prices, and their keys."""

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from pydrake.common.yaml import yaml_load_typed

from tog_drake.errors import InputError
from tog_drake.selectors.vlm.anthropic import Anthropic
from tog_drake.selectors.vlm.gemini import Gemini
from tog_drake.selectors.vlm.keys import read_key, redact, require_key
from tog_drake.selectors.vlm.openai import Molmo, OpenAi, Qwen
from tog_drake.selectors.vlm.prices import load_prices
from tog_drake.selectors.vlm.specification import (
    PROVIDERS,
    check_model,
    read_specification,
    specification,
)

PROVIDER_KEYS = ("OPENAI_API_KEY", "GOOGLE_API_KEY", "GEMINI_API_KEY", "ANTHROPIC_API_KEY")
KEY = "sk-proj-4f9a8b7c6d5e4f3a2b1c"

SPECIFICATIONS = {
    "openai:gpt-6.1-sol": (OpenAi, "https://api.openai.com/v1/chat/completions"),
    "openai:any@http://127.0.0.1:8080/v1": (OpenAi, "http://127.0.0.1:8080/v1/chat/completions"),
    "openai:qwen2.5vl:7b@http://localhost:11434/v1": (
        OpenAi,
        "http://localhost:11434/v1/chat/completions",
    ),
    "openai:a@b/c@http://[::1]:8/v1": (OpenAi, "http://[::1]:8/v1/chat/completions"),
    "gemini:gemini-3.8-flash": (
        Gemini,
        "https://generativelanguage.googleapis.com/v1beta/models/gemini-3.8-flash:generateContent",
    ),
    "anthropic:claude-sonnet-5-5": (Anthropic, "https://api.anthropic.com/v1/messages"),
    "molmo:allenai/Molmo2-8B": (Molmo, "http://localhost:8000/v1/chat/completions"),
    "qwen:Qwen2.5-VL-7B@http://gpu:1/v1": (Qwen, "http://gpu:1/v1/chat/completions"),
}


@pytest.mark.parametrize("text", SPECIFICATIONS)
def test_a_line_names_a_model_and_back(text):
    kind, url = SPECIFICATIONS[text]
    config = read_specification(text)
    assert type(config) is kind
    assert config.url() == url
    assert url.endswith(config.path())
    assert specification(config) == text


@pytest.mark.parametrize(
    "text",
    [
        "",
        "gpt-6",
        "openai:",
        "openai:@http://localhost/v1",
        "gpt:gpt-6",
        "OPENAI:gpt-6",
        "openai:two words",
        "openai:any@http://",
        "openai:any@http://host:port/v1",
        "openai:any@http://[::1/v1",
        "openai:any@http://user:secret@host/v1",
        "openai:any@https://host/v1?key=secret",
        "openai:any@https://host/v1#secret",
        "qwen:any@http://localhost:8000/v1",
        "molmo:mine@http://localhost:8000/v1",
    ],
)
def test_what_names_no_model_is_refused_and_no_secret_of_it_is_shown(text):
    with pytest.raises(InputError, match=r"valid:|environment variable|profile") as info:
        read_specification(text)
    assert "host/v1?key" not in str(info.value)
    assert "user:secret" not in str(info.value)


HOSTS = st.from_regex(
    r"([a-z][a-z0-9-]{0,8}(\.[a-z]{2,3})?|[0-9]{1,3}(\.[0-9]{1,3}){3}|\[::1\])(:[0-9]{1,5})?(/v1)?/?",
    fullmatch=True,
).filter(lambda host: host not in ("latest", "default"))


@given(
    st.sampled_from(sorted(PROVIDERS)),
    st.sampled_from(["any", "gpt-5", "a@b", "qwen2.5vl:7b", "molmo"]),
    st.sampled_from(["", "http:/", "http:", "HTTP://", "ftp://", "//", "user:secret@"]),
    HOSTS,
)
@example("openai", "any", "", "127.0.0.1:8080/v1")
@example("openai", "gpt-5", "", "localhost:11434/v1")
@example("openai", "gpt-5", "", "localhost")
def test_an_address_without_http_is_never_taken_for_part_of_a_name(provider, model, before, host):
    with pytest.raises(InputError, match="begins with http:// or https://") as info:
        read_specification(f"{provider}:{model}@{before}{host}", profile="pixels")
    assert "secret" not in str(info.value)
    with pytest.raises(InputError, match="begins with http:// or https://"):
        check_model(PROVIDERS[provider](model=f"{model}@{before}{host}", profile="pixels"))


def test_a_version_after_an_at_sign_belongs_to_the_name():
    assert read_specification("anthropic:claude-opus@20250514").model == "claude-opus@20250514"


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("ollama:llava", "openai:llava@http://localhost:11434/v1"),
        ("Ollama:qwen2.5vl:7b", "openai:qwen2.5vl:7b@http://localhost:11434/v1"),
        ("vllm:Qwen/Qwen3-VL-8B", "openai:Qwen/Qwen3-VL-8B@http://localhost:8000/v1"),
        ("gpt-4o", "openai:gpt-4o"),
        ("gemini-3.8-flash", "gemini:gemini-3.8-flash"),
        ("claude-sonnet-5-5", "anthropic:claude-sonnet-5-5"),
    ],
)
def test_what_was_probably_meant_is_said_and_is_valid(text, meant):
    with pytest.raises(InputError, match=f"did you mean {meant};"):
        read_specification(text)
    read_specification(meant, profile="pixels")


@pytest.mark.parametrize(
    ("text", "right"),
    [
        ("openai:any@http://h:1/v1/chat/completions", "http://h:1/v1"),
        ("openai:any@http://h:1/v1/chat/completions/", "http://h:1/v1"),
        ("anthropic:claude-opus-5@http://h/v1/messages", "http://h"),
        ("anthropic:claude-opus-5@http://h/v1", "http://h"),
        ("gemini:gemini-9@http://h/v1beta", "http://h"),
    ],
)
def test_an_address_of_an_endpoint_is_refused_with_the_right_one(text, right):
    with pytest.raises(InputError, match=f"; valid: {right}$"):
        read_specification(text)


@given(st.text() | st.from_regex(r"(openai|gemini|qwen):[^ ]{0,9}@https?://.{0,9}", fullmatch=True))
@example("openai:any@http://a..b/v1")
def test_every_text_is_a_model_or_is_refused(text):
    try:
        config = read_specification(text, profile="pixels")
    except InputError:
        return
    assert read_specification(specification(config), profile="pixels") == config


def test_a_model_may_be_named_that_does_not_say_how_it_points_if_the_profile_is():
    assert read_specification("qwen:mine", profile="qwen3-vl").profile == "qwen3-vl"


@pytest.mark.parametrize("kind", PROVIDERS.values())
def test_a_model_in_a_scenario_may_have_every_field(kind):
    config = yaml_load_typed(schema=kind, data="{model: m, effort: low, max_tokens: 99}")
    assert (config.model, config.effort, config.max_tokens) == ("m", "low", 99)
    check_model(yaml_load_typed(schema=kind, data="{model: qwen-molmo}"))
    with pytest.raises(InputError, match="max_tokens"):
        check_model(kind(model="qwen-molmo", max_tokens=0))


def test_a_model_of_google_cannot_lead_to_another_path():
    assert "/models/..%2F..%2Fv1%3Fx:generate" in Gemini(model="../../v1?x").url()


def test_a_key_comes_from_its_variable(monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", f" {KEY}\n")
    assert OpenAi().headers() == {"Authorization": f"Bearer {KEY}"}
    assert KEY not in repr(OpenAi())


def test_gemini_has_two_variables(monkeypatch):
    monkeypatch.delenv("GOOGLE_API_KEY", raising=False)
    monkeypatch.setenv("GEMINI_API_KEY", "another-key")
    assert Gemini().headers() == {"x-goog-api-key": "another-key"}
    monkeypatch.setenv("GOOGLE_API_KEY", KEY)  # first, as with Google's own client
    assert Gemini().headers() == {"x-goog-api-key": KEY}


def test_a_key_is_not_sent_where_others_can_read_it(monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    monkeypatch.setenv("ANTHROPIC_API_KEY", KEY)
    assert OpenAi(base_url="http://192.168.0.7:8000/v1").headers() == {}
    assert OpenAi(base_url="http://localhost.example.com/v1").headers() == {}
    assert KEY in str(OpenAi(base_url="http://localhost:8000/v1").headers())
    with pytest.raises(InputError, match="valid: https"):
        Anthropic(base_url="http://api.anthropic.com").headers()
    with pytest.raises(InputError, match="valid: https"):
        OpenAi(base_url="http://api.openai.com/v1").headers()


@pytest.mark.parametrize("host", ["https://evil.example", "https://api.openai.com.evil.example"])
@pytest.mark.parametrize("kind", [OpenAi, Qwen, Molmo, Gemini, Anthropic])
def test_a_provider_s_key_goes_to_no_other_host(kind, host, monkeypatch):
    for variable in PROVIDER_KEYS:
        monkeypatch.setenv(variable, KEY)
    monkeypatch.setenv("VLM_API_KEY", "of-another-server")
    monkeypatch.setenv("LAB_API_KEY", "of-the-laboratory")
    config = kind(model="qwen molmo", base_url=host)
    assert "of-another-server" in str(config.headers())
    assert KEY not in str(config.headers())
    config.key_variable = "LAB_API_KEY"
    assert "of-the-laboratory" in str(config.headers())
    for variable in PROVIDER_KEYS:
        config.key_variable = variable
        for refuses in (config.headers, lambda: check_model(config)):
            with pytest.raises(InputError, match=f"{variable}.* is not sent to .*VLM_API_KEY"):
                refuses()


@pytest.mark.parametrize("kind", [OpenAi, Gemini, Anthropic])
def test_a_provider_s_own_host_gets_no_other_provider_s_key(kind, monkeypatch):
    for variable in PROVIDER_KEYS:
        monkeypatch.setenv(variable, KEY)
    own = kind(model="any").key_variables()
    assert KEY in str(kind(model="any", key_variable=own[0]).headers())
    for other in set(PROVIDER_KEYS) - set(own):
        with pytest.raises(InputError, match="belongs to"):
            kind(model="any", key_variable=other).headers()
        assert KEY in str(
            kind(model="any", base_url="http://[::1]:8", key_variable=other).headers()
        )


def test_a_server_without_a_key_of_its_own_is_sent_none(monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    monkeypatch.delenv("VLM_API_KEY", raising=False)
    assert OpenAi("any", "https://openrouter.ai/api/v1").headers() == {}
    for kind in (Gemini, Anthropic):  # these protocols want one
        with pytest.raises(InputError, match="set the environment variable VLM_API_KEY"):
            kind("any", "https://gateway.example").headers()


def test_a_missing_key_is_said_to_be_missing(monkeypatch):
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    with pytest.raises(InputError, match="set the environment variable OPENAI_API_KEY"):
        OpenAi().headers()
    assert OpenAi(base_url="https://openrouter.ai/api/v1").headers() == {}


@pytest.mark.parametrize("variable", ["HOME", "AWS_SECRET_ACCESS_KEY", "", "x_API_KEY", "_API_KEY"])
def test_a_scenario_cannot_have_other_variables_sent_away(variable):
    with pytest.raises(InputError, match="key_variable"):
        read_key(variable, "https://example.com")


@pytest.mark.parametrize("key", ["two of themmm", "line\nendddddd", "schlüsselll", "aaaa\x7fbbbb"])
def test_what_cannot_be_a_key_is_refused_without_showing_it(key, monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", key)
    with pytest.raises(InputError, match="OPENAI_API_KEY") as info:
        require_key(["OPENAI_API_KEY"], "https://api.openai.com/v1")
    assert key[-5:] not in str(info.value)


@given(st.text(), st.text(), st.integers(0, 20), st.integers(8, 28))
def test_no_stretch_of_a_key_is_left_in_a_text(before, after, start, length):
    shown = redact(before + KEY[start : start + length].upper() + after, [KEY])
    assert not any(KEY[i : i + 8] in shown.lower() for i in range(len(KEY) - 7))
    if len(KEY[start : start + length]) >= 8:
        assert "[key]" in shown
        assert shown.startswith(before[: len(before) // 2])


@given(st.text(st.characters()))
def test_text_without_keys_stays_as_it_is(text):
    assert redact(text, [KEY, ""]) == text


def test_prices_know_whom_they_are_paid_to(monkeypatch):
    monkeypatch.delenv("TOG_PRICES", raising=False)
    prices = load_prices()
    tokens = {"input": 1000, "output": 100}
    google = Gemini(model="gemini-3.8-flash").url()
    assert prices.as_of == "2026-11-22"
    assert prices.cost(google, "gemini-3.8-flash", tokens) == pytest.approx(0.001125)
    assert prices.cost(google, "gemini-3.8-flash-001", tokens) == pytest.approx(0.001125)
    assert prices.cost(google, "gemini-3.8-flash-lite", tokens) is None
    assert prices.cost(google, "gemini-3.8-flash", None) is None
    assert prices.cost(google, "gemini-3.8-flash", {"input": 1000}) is None
    assert prices.cost("http://localhost:8000/v1", "gemini-3.8-flash", tokens) is None
    claude = Anthropic(model="claude-sonnet-5-5").url()
    assert prices.cost(claude, "claude-sonnet-5-5-20260901", tokens) == pytest.approx(0.003)


def test_own_prices_go_before_ours(tmp_path, monkeypatch):
    own = tmp_path / "prices.yaml"
    own.write_text(
        "hosts:\n  api.openai.com:\n    gpt-6-luna: {input: 7, output: 0}\n"
        "  openrouter.ai:\n    qwen/qwen3-vl: {input: 1, output: 1}\n"
    )
    monkeypatch.setenv("TOG_PRICES", str(own))
    prices, tokens = load_prices(), {"input": 1_000_000, "output": 0}
    assert prices.cost("https://api.openai.com/v1", "gpt-6-luna", tokens) == 7.0
    assert prices.cost("https://api.openai.com/v1", "gpt-6.1-sol", tokens) == 2.0
    assert prices.cost("https://openrouter.ai/api/v1", "qwen/qwen3-vl", tokens) == 1.0


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[]",
        "hosts: 7",
        "hosts: {a: {b: 1}}",
        "hosts: {a: {b: {input: -1, output: 1}}}",
        "hosts: {a: {b: {input: .nan, output: 1}}}",
        "hosts: {a: {b: {input: x, output: 1}}}",
        "hosts: {a: {b: {input: 1}}}",
        "{",
        "!!python/object/apply:os.getcwd []",
    ],
)
def test_a_table_of_prices_that_is_none_is_refused(content, tmp_path, monkeypatch):
    own = tmp_path / "prices.yaml"
    own.write_text(content)
    monkeypatch.setenv("TOG_PRICES", str(own))
    with pytest.raises(InputError, match="TOG_PRICES"):
        load_prices()
    monkeypatch.setenv("TOG_PRICES", str(tmp_path / "none.yaml"))
    with pytest.raises(InputError, match="TOG_PRICES"):
        load_prices()
