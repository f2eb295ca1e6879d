from .prompt_run import run_prompts as run_prompts
from .prompt_run import sample_prompt as sample_prompt
from .prompts import PromptConfig as PromptConfig
from .transcripts import reading_scores as reading_scores
from .transcripts import reading_table as reading_table
from .transcripts import show_transcripts as show_transcripts
