"""Vision-language models behind a chat-completions server: prompts, answers, transcripts."""
