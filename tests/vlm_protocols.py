"""The protocols of OpenAI, Google and Anthropic, seen from the server: what is a request in order,
how an answer looks, and how an error.
"""

import re


class Refusal(Exception):
    """The request is not in order: status, message, name of the parameter."""

    def __init__(self, status, message, param=None):
        super().__init__(message)
        self.status, self.param = status, param


def _want(condition, message, param=None):
    if not condition:
        raise Refusal(400, message, param)


def _check_schema(schema):
    """What strict structured output asks of a schema, with OpenAI and Anthropic."""
    _want(isinstance(schema, dict), "schema: must be an object", "response_format")
    if schema.get("type") == "object":
        _want(
            schema.get("additionalProperties") is False,
            "Invalid schema for response_format: 'additionalProperties' is required to be supplied "
            "and to be false.",
        )
        properties = schema.get("properties", {})
        _want(
            set(schema.get("required", ())) == set(properties),
            "Invalid schema for response_format: 'required' is required to be supplied and to be "
            "an array including every key in properties.",
        )
        for inner in properties.values():
            _check_schema(inner)
    elif schema.get("type") == "array":
        _check_schema(schema.get("items"))


class OpenAiProtocol:
    name = "openai"
    pattern = re.compile(r"/v1/chat/completions")
    key_header = "Authorization"
    known = frozenset(
        [
            "model",
            "messages",
            "max_tokens",
            "max_completion_tokens",
            "response_format",
            "reasoning_effort",
            "n",
            "stop",
            "stream",
            "temperature",
            "top_p",
            "seed",
            "chat_template_kwargs",
        ]
    )

    @staticmethod
    def check_key(headers, key):
        if key is not None and headers.get("Authorization") != f"Bearer {key}":
            raise Refusal(401, "You didn't provide an API key, or not the right one.")

    @classmethod
    def check(cls, body):
        _want(isinstance(body, dict), "Invalid body: expected an object.")
        for name in set(body) - cls.known:
            raise Refusal(400, f"Unrecognized request argument supplied: {name}")
        _want(isinstance(body.get("model"), str) and body["model"], "you must provide a model")
        both = "max_tokens" in body and "max_completion_tokens" in body
        _want(not both, "Setting 'max_tokens' and 'max_completion_tokens' at the same time")
        for limit in ("max_tokens", "max_completion_tokens"):
            _want(isinstance(body.get(limit, 1), int), f"Invalid type for '{limit}'", limit)
        messages = body.get("messages")
        _want(isinstance(messages, list) and messages, "Missing required parameter: 'messages'.")
        for message in messages:
            _want(message.get("role") in ("user", "system", "assistant", "developer"), "role")
            for part in cls.parts(message):
                _want(part.get("type") in ("text", "image_url"), "Invalid value: 'type'")
                if part["type"] == "text":
                    _want(isinstance(part.get("text"), str), "Missing parameter: 'text'")
                else:
                    url = part.get("image_url")
                    _want(isinstance(url, dict), "Invalid type for 'image_url': an object")
                    known = str(url.get("url", "")).startswith("data:image/png;base64,")
                    _want(known, "image URLs are not currently supported, please use base64")
        if "response_format" in body:
            cls.check_format(body["response_format"])

    @staticmethod
    def check_format(wanted):
        _want(wanted.get("type") == "json_schema", "Invalid value: 'response_format.type'")
        schema = wanted.get("json_schema", {})
        _want(re.fullmatch(r"[\w-]{1,64}", str(schema.get("name", ""))), "json_schema.name")
        _want(
            "schema" in schema, "Missing required parameter: 'response_format.json_schema.schema'"
        )
        if schema.get("strict"):
            _check_schema(schema["schema"])

    @staticmethod
    def parts(message):
        content = message.get("content")
        if isinstance(content, str):
            return [{"type": "text", "text": content}]
        _want(isinstance(content, list) and content, "Invalid type for 'messages[0].content'")
        return content

    @classmethod
    def contents(cls, body):
        parts = [part for message in body["messages"] for part in cls.parts(message)]
        texts = [part["text"] for part in parts if part["type"] == "text"]
        urls = [part["image_url"]["url"] for part in parts if part["type"] == "image_url"]
        return texts, [url.partition(",")[2] for url in urls]

    @staticmethod
    def has(body, name):
        return name in body

    @staticmethod
    def lacks(name):
        other = {
            "max_tokens": "max_completion_tokens",
            "max_completion_tokens": "max_tokens",
        }.get(name)
        hint = f" Use '{other}' instead." if other else ""
        return f"Unsupported parameter: '{name}' is not supported with this model.{hint}"

    @staticmethod
    def error(code, message, param):
        return {"error": {"message": message, "type": "error", "param": param, "code": None}}

    @staticmethod
    def reply(spoken, vlm):
        finish = {"refusal": "stop", "blocked": "content_filter"}.get(spoken.finish, spoken.finish)
        message = {"role": "assistant", "content": spoken.text, "refusal": spoken.refusal}
        if spoken.reasoning is not None:  # as vLLM says it, and as llama.cpp does
            message |= {"reasoning": spoken.reasoning, "reasoning_content": spoken.reasoning}
        return {
            "id": "chatcmpl-1",
            "object": "chat.completion",
            "created": 1_700_000_000,
            "model": vlm.model,
            "choices": [{"index": 0, "message": message, "finish_reason": finish}],
            "usage": {
                "prompt_tokens": 1000,
                "completion_tokens": 50,
                "total_tokens": 1050,
                "completion_tokens_details": {"reasoning_tokens": 30},
            },
        }


class GeminiProtocol:
    name = "gemini"
    pattern = re.compile(r"/v1beta/models/[^/:]+:generateContent")
    key_header = "x-goog-api-key"
    known = frozenset(
        [
            "maxOutputTokens",
            "responseMimeType",
            "responseSchema",
            "responseJsonSchema",
            "thinkingConfig",
            "mediaResolution",
            "temperature",
            "topP",
            "topK",
            "seed",
        ]
    )

    @staticmethod
    def check_key(headers, key):
        given = headers.get("x-goog-api-key")
        if given is None:
            raise Refusal(403, "Method doesn't allow unregistered callers. Please use API Key.")
        if given != key:
            raise Refusal(400, "API key not valid. Please pass a valid API key.")

    @classmethod
    def check(cls, body):
        def known(value, names, where):
            for name in set(value) - set(names):
                raise Refusal(
                    400,
                    f'Invalid JSON payload received. Unknown name "{name}" at {where!r}: '
                    "Cannot find field.",
                )

        known(body, ("contents", "systemInstruction", "generationConfig", "safetySettings"), "")
        config = body.get("generationConfig", {})
        known(config, cls.known, "generation_config")
        thinking = config.get("thinkingConfig", {})
        known(thinking, ("thinkingLevel", "thinkingBudget", "includeThoughts"), "thinking_config")
        if {"responseSchema", "responseJsonSchema"} & set(config):
            mime = config.get("responseMimeType")
            _want(mime == "application/json", "response_mime_type must be application/json")
        contents = body.get("contents")
        _want(isinstance(contents, list) and contents, "* GenerateContentRequest.contents: empty")
        for content in contents:
            _want(content.get("role", "user") in ("user", "model"), "Please use a valid role")
            _want(content.get("parts"), "contents.parts must not be empty.")
            for part in content["parts"]:
                known(part, ("text", "inlineData", "inline_data"), "contents[0].parts[0]")
                _want(len(part) == 1, "oneof field 'data' is already set")
                blob = part.get("inlineData") or part.get("inline_data")
                if blob is not None:
                    mime = blob.get("mimeType") or blob.get("mime_type")
                    _want(mime == "image/png", f"Unsupported MIME type: {mime}")

    @staticmethod
    def contents(body):
        parts = [part for content in body["contents"] for part in content["parts"]]
        blobs = [part.get("inlineData") or part.get("inline_data") for part in parts]
        return [p["text"] for p in parts if "text" in p], [b["data"] for b in blobs if b]

    @staticmethod
    def has(body, name):
        return name in body.get("generationConfig", {})

    @staticmethod
    def lacks(name):
        return {
            "thinkingConfig": "Thinking level is not supported for this model.",
            "responseJsonSchema": "JSON mode is not enabled for this model",
        }.get(name, f"Unknown name {name}: Cannot find field.")

    @staticmethod
    def error(code, message, param):
        words = {400: "INVALID_ARGUMENT", 403: "PERMISSION_DENIED", 429: "RESOURCE_EXHAUSTED"}
        return {"error": {"code": code, "message": message, "status": words.get(code, "INTERNAL")}}

    @staticmethod
    def reply(spoken, vlm):
        body = {
            "usageMetadata": {
                "promptTokenCount": 1000,
                "candidatesTokenCount": 20,
                "thoughtsTokenCount": 30,
                "totalTokenCount": 1050,
            },
            "modelVersion": vlm.model,
            "responseId": "r-1",
        }
        if spoken.finish == "blocked":
            return {"promptFeedback": {"blockReason": "SAFETY"}, **body}
        finish = {"stop": "STOP", "length": "MAX_TOKENS", "refusal": "PROHIBITED_CONTENT"}
        candidate = {"finishReason": finish[spoken.finish], "index": 0}
        parts = []
        if spoken.reasoning is not None:
            parts.append({"text": spoken.reasoning, "thought": True})
        if spoken.text is not None:
            parts += [{"text": spoken.text}, {"thoughtSignature": "c2lnbmF0dXJl"}]
        content = {"role": "model", "parts": parts} if parts else {"role": "model"}
        return {"candidates": [{"content": content, **candidate}], **body}


class AnthropicProtocol:
    name = "anthropic"
    pattern = re.compile(r"/v1/messages")
    key_header = "x-api-key"
    known = frozenset(
        ["model", "max_tokens", "messages", "system", "output_config", "thinking", "stream"]
    )

    @staticmethod
    def check_key(headers, key):
        if headers.get("x-api-key") != key:
            raise Refusal(401, "invalid x-api-key")
        _want("anthropic-version" in headers, "anthropic-version: header is required")

    @classmethod
    def check(cls, body):
        for name in set(body) - cls.known:
            raise Refusal(400, f"{name}: Extra inputs are not permitted")
        for name in ("model", "max_tokens", "messages"):
            _want(name in body, f"{name}: Field required")
        _want(isinstance(body["max_tokens"], int) and body["max_tokens"] > 0, "max_tokens: integer")
        _want(isinstance(body["messages"], list) and body["messages"], "messages: at least one")
        config = body.get("output_config", {})
        for name in set(config) - {"effort", "format"}:
            raise Refusal(400, f"output_config.{name}: Extra inputs are not permitted")
        if "format" in config:
            _want(config["format"].get("type") == "json_schema", "output_config.format.type")
            _check_schema(config["format"].get("schema"))
        for message in body["messages"]:
            _want(message.get("role") in ("user", "assistant"), "messages.0.role: Input should be")
            for block in cls.blocks(message):
                cls.check_block(block)
        _want(body["messages"][-1]["role"] == "user", "This model does not support prefill.")

    @staticmethod
    def check_block(block):
        if block.get("type") == "text":
            text = block.get("text")
            _want(isinstance(text, str) and text.strip(), "text content blocks must be non-empty")
        elif block.get("type") == "image":
            source = block.get("source", {})
            _want(source.get("type") == "base64", "messages.0.content.0.image.source.type")
            _want(source.get("media_type") == "image/png", "image.source.media_type: Input should")
        else:
            raise Refusal(400, "messages.0.content.0: Input tag does not match any of the expected")

    @staticmethod
    def blocks(message):
        content = message.get("content")
        if isinstance(content, str):
            return [{"type": "text", "text": content}]
        _want(isinstance(content, list) and content, "messages.0.content: Field required")
        return content

    @classmethod
    def contents(cls, body):
        blocks = [block for message in body["messages"] for block in cls.blocks(message)]
        texts = [block["text"] for block in blocks if block["type"] == "text"]
        return texts, [block["source"]["data"] for block in blocks if block["type"] == "image"]

    @staticmethod
    def has(body, name):
        first, _, rest = name.partition(".")
        return first in body and (not rest or rest in body[first])

    @staticmethod
    def lacks(name):
        return {
            "output_config.effort": "This model does not support the effort parameter.",
        }.get(name, f"{name}: Extra inputs are not permitted")

    @staticmethod
    def error(code, message, param):
        kinds = {
            400: "invalid_request_error",
            401: "authentication_error",
            429: "rate_limit_error",
            529: "overloaded_error",
        }
        error = {"type": kinds.get(code, "api_error"), "message": message}
        return {"type": "error", "error": error, "request_id": "req_1"}

    @staticmethod
    def reply(spoken, vlm):
        content = []
        if spoken.reasoning is not None:
            content.append({"type": "thinking", "thinking": spoken.reasoning, "signature": "c2ln"})
        if spoken.text is not None:
            content.append({"type": "text", "text": spoken.text})
        stop = {"stop": "end_turn", "length": "max_tokens"}.get(spoken.finish, "refusal")
        return {
            "id": "msg_1",
            "type": "message",
            "role": "assistant",
            "model": vlm.model,
            "content": content,
            "stop_reason": stop,
            "stop_sequence": None,
            "stop_details": {"type": "refusal", "category": None, "explanation": spoken.refusal}
            if stop == "refusal"
            else None,
            "usage": {
                "input_tokens": 1000,
                "output_tokens": 50,
                "output_tokens_details": {"thinking_tokens": 30},
            },
        }


PROTOCOLS = (OpenAiProtocol, GeminiProtocol, AnthropicProtocol)
