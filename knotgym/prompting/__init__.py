"""Evaluate vision-language models: prompts, a client with limits, answers, transcripts."""
