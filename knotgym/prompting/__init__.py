"""Evaluate vision-language models: prompts, a client with limits, answers, transcripts."""

from knotgym.common.lazy_exports import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "Chat": "knotgym.prompting.chat",
        "ChatConfig": "knotgym.prompting.chat",
        "PromptConfig": "knotgym.prompting.prompted_episodes",
        "TranscriptPolicy": "knotgym.prompting.transcript_policy",
        "read_transcripts": "knotgym.prompting.transcripts",
        "reading_scores": "knotgym.prompting.reading_scores",
        "run_prompts": "knotgym.prompting.prompt_run",
        "sample_prompt": "knotgym.prompting.prompt_run",
        "summarize": "knotgym.prompting.summary",
    },
)
