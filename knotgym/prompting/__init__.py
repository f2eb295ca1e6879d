"""Evaluate vision-language models: prompts, a chat-completions client, answers, transcripts."""
